/* See motor_board.h. Sections are those of docs/reference/firmware.md. */
#include "motor_board.h"

/* Compilers without a C library lack string.h, but call these themselves. */
void *memcpy(void *restrict to, const void *restrict from, size_t size);
void *memmove(void *to, const void *from, size_t size);

enum { HEARTBEAT = 0, SYS_STATUS = 1, COMMAND_LONG = 76, COMMAND_ACK = 77, TIMESYNC = 111,
       ACTUATOR_TARGET = 139, BATTERY_STATUS = 147, ESC_INFO = 290, ESC_STATUS = 291 };
enum { ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED };
enum { MARKER = 0xFD, HEADER = 10, CHECKSUM = 2, LONGEST_READ = 43, LONGEST_WRITTEN = 57 };
enum { BOARD_SYSTEM = 1, BOARD_COMPONENT = 1, HOST_SYSTEM = 1, HOST_COMPONENT = 191,
       BOARD_ADDRESS = BOARD_SYSTEM | BOARD_COMPONENT << 8 };
enum { ARM_DISARM = 400, CONTRACT_VERSION = 1, STUCK = 32, GENERIC = 64, NO_TEMPERATURE = 32767 };
/* [us] */
enum { HEARTBEAT_SPACING = 20000, ALIVE = 20000, ESC_SILENCE = 100000, ESC_START = 200000 };
#define NEVER UINT64_MAX

const mb_numbers mb_contract = {
    .target_timeout = 100000, .heartbeat_timeout = 1000000, .idle_timeout = 2000000,
    .throttle_low_time = 1000000, .target_age_limit = 100000, .target_future_limit = 50000,
    .boot_time = 300000, .arm_voltage = 6 * 3500, .esc_telemetry = 1,
    .periods = {200000, 20000, 10000, 500000, 1000000},
};
const size_t mb_size = sizeof(mb_board);

/* --- frames, section 1 ----------------------------------------------------------------------- */

typedef struct {
    uint8_t bytes[HEADER + LONGEST_WRITTEN + CHECKSUM];
    size_t size;
} frame;

/* CRC_EXTRA of a message of the computer, or -1: its checksum cannot be tested. */
static int extra_of(uint32_t id) {
    return id == HEARTBEAT ? 50 : id == COMMAND_LONG ? 152 : id == TIMESYNC ? 34
        : id == ACTUATOR_TARGET ? 168 : -1;
}

static uint16_t crc_of(const uint8_t *bytes, size_t size, int extra) {
    uint32_t crc = 0xFFFF;
    for (size_t k = 0; k <= size; k++) {
        uint32_t byte = (crc ^ (k < size ? bytes[k] : (uint32_t)extra)) & 0xFF;
        byte = (byte ^ byte << 4) & 0xFF;
        crc = (crc >> 8 ^ byte << 8 ^ byte << 3 ^ byte >> 4) & 0xFFFF;
    }
    return (uint16_t)crc;
}

static uint64_t get(const uint8_t *bytes, unsigned size) {
    uint64_t value = 0;
    while (size-- > 0)
        value = value << 8 | bytes[size];
    return value;
}

/* Append pairs of a value and its size in bytes. */
#define PUT(made, ...) put(made, (const uint64_t[]){__VA_ARGS__}, \
                           sizeof((const uint64_t[]){__VA_ARGS__}) / sizeof(uint64_t))
static void put(frame *made, const uint64_t *pairs, size_t count) {
    for (size_t k = 0; k < count; k += 2)
        for (uint64_t rest = pairs[k], byte = 0; byte < pairs[k + 1]; byte++, rest >>= 8)
            made->bytes[made->size++] = (uint8_t)(rest & 0xFF);
}

static void put_thousandth(frame *made, int32_t value) {
    const float scaled = (float)value / 1000.0F;
    uint32_t bits;
    memcpy(&bits, &scaled, sizeof bits);
    PUT(made, bits, 4);
}

/* Finish and send; `seq` counts sent frames only: a dropped one is not a loss of the link. */
static bool sent(mb_board *board, frame *made, uint32_t id, int extra) {
    while (made->size > HEADER + 1 && made->bytes[made->size - 1] == 0)
        made->size--;
    const size_t end = made->size;
    made->size = 0;
    PUT(made, MARKER, 1, end - HEADER, 1, 0, 2, board->sequence, 1, BOARD_SYSTEM, 1,
        BOARD_COMPONENT, 1, id, 3);
    made->size = end;
    PUT(made, crc_of(made->bytes + 1, end - 1, extra), CHECKSUM);
    if (!board->send(board->context, made->bytes, made->size))
        return false;
    board->sequence++;
    return true;
}

/* --- state machine, section 3 ---------------------------------------------------------------- */

static bool within(uint64_t at, uint64_t now, uint32_t limit) {
    return at != NEVER && now - at < limit;
}

static bool fresh(const mb_board *board, uint64_t now) {
    return within(board->target_at, now, board->numbers.target_timeout);
}

/* The interrupt sees the old output or the new one, never a mixture. */
static void show(mb_board *board, const uint32_t *pulses, uint64_t until) {
    mb_output *output = &board->outputs[1 - board->shown];
    for (unsigned k = 0; k < MB_ROTORS; k++)
        output->pulses[k] = pulses ? pulses[k] : (uint32_t)MB_STOP;
    output->until = until;
    board->shown = 1 - board->shown;
}

static void disarm(mb_board *board, uint8_t reason) {
    show(board, NULL, 0);
    board->armed = board->executing = false;
    board->target_at = NEVER;
    board->stop_reason = reason;
}

static void advance(mb_board *board, uint64_t now) {
    if (!board->armed)
        return;
    if (!within(board->heartbeat_at, now, board->numbers.heartbeat_timeout)) {
        disarm(board, MB_HEARTBEAT_LOST);
    } else if (!within(board->active_at, now, board->numbers.idle_timeout)) {
        disarm(board, MB_NO_TARGET);
    } else if (board->executing && !fresh(board, now)) {
        show(board, NULL, 0);
        board->executing = false;
        board->timeouts++;
    }
}

unsigned mb_state(mb_board *board, uint64_t now) {
    advance(board, now);
    return !board->announced ? MB_BOOT : !board->armed ? MB_DISARMED
        : fresh(board, now) ? MB_RUNNING : MB_ARMED;
}

unsigned mb_conditions(mb_board *board, uint64_t now) {
    const mb_numbers *numbers = &board->numbers;
    advance(board, now);
    bool failed = false;
    for (unsigned k = 0; k < MB_ROTORS; k++)
        failed = failed || !board->escs[k].online || board->escs[k].failures;
    const bool timed_out = board->armed && board->target_at != NEVER && !fresh(board, now);
    return (board->announced ? 0U : MB_BOOTING)
        | (within(board->heartbeat_at, now, numbers->heartbeat_timeout) ? 0U : MB_NO_HEARTBEAT)
        | (!board->armed && within(board->thrust_at, now, numbers->throttle_low_time)
           ? MB_THROTTLE : 0U)
        | (board->millivolts < (int32_t)numbers->arm_voltage ? MB_BATTERY_LOW : 0U)
        | (failed ? MB_ESC_FAILURE : 0U) | (timed_out ? MB_TIMED_OUT : 0U)
        | (board->saturated && fresh(board, now) ? MB_SATURATED : 0U);
}

/* --- messages from the computer, section 4 --------------------------------------------------- */

static void take_target(mb_board *board, const uint8_t *payload, uint64_t now) {
    const mb_numbers *numbers = &board->numbers;
    const uint64_t stamp = get(payload, 8);
    uint32_t pulses[MB_ROTORS];
    bool finite = true, others = false, thrust = false, clipped = false;
    for (unsigned k = 0; k < 8; k++) {
        const uint32_t bits = (uint32_t)get(payload + 8 + 4 * k, 4);
        float control;
        memcpy(&control, &bits, sizeof control);
        if ((bits & 0x7F800000U) == 0x7F800000U) {      /* holds with every compiler option */
            finite = false;
        } else if (k >= MB_ROTORS) {
            others = others || control < 0.0F || control > 0.0F;
        } else {
            thrust = thrust || control > 0.0F;
            clipped = clipped || control < 0.0F || control > 1.0F;
            control = control > 1.0F ? 1.0F : control > 0.0F ? control : 0.0F;
            pulses[k] = (uint32_t)MB_STOP + (uint32_t)((double)control * 1e6 + 0.5);
        }
    }
    int refusal = get(payload + 41, 2) != BOARD_ADDRESS ? MB_ADDRESSEE
        : payload[40] != 0 ? MB_GROUP : !finite ? MB_NOT_FINITE : others ? MB_MORE_ROTORS
        : now > stamp && now - stamp > numbers->target_age_limit ? MB_STALE
        : stamp > now && stamp - now > numbers->target_future_limit ? MB_FUTURE
        : stamp < board->target_stamp ? MB_OLDER : -1;
    if (refusal < 0) {
        const bool newer = stamp > board->target_stamp;
        board->target_stamp = stamp;
        if (thrust)
            board->thrust_at = now;
        if (!board->armed) {
            refusal = MB_NOT_ARMED;
        } else if (newer) {     /* a repeated target does not restart the timeout */
            board->target_at = board->active_at = now;
            board->executing = true;
        }
    }
    if (refusal >= 0) {
        board->refused[refusal]++;
    } else if (fresh(board, now)) {
        board->saturated = clipped;
        show(board, pulses, board->target_at + numbers->target_timeout);
    }
}

static void obey(mb_board *board, const uint8_t *payload, uint64_t now) {
    const uint32_t arm = (uint32_t)get(payload, 4), force = (uint32_t)get(payload + 4, 4);
    const uint32_t command = (uint32_t)get(payload + 28, 2);
    const bool one = arm == 0x3F800000U, zero = (arm & 0x7FFFFFFFU) == 0;   /* bits of a float */
    unsigned result = ACCEPTED, blocking = 0;
    if (command != ARM_DISARM) {
        result = UNSUPPORTED;
    } else if (!(one || zero) || (one && (force & 0x7FFFFFFFU) != 0)) {
        result = DENIED;
    } else if (zero && board->armed) {
        disarm(board, MB_REQUESTED);
    } else if (one && !board->armed) {
        blocking = mb_conditions(board, now) & MB_BLOCKS_ARMING;
        result = blocking ? TEMPORARILY_REJECTED : ACCEPTED;
        board->armed = !blocking;
        board->active_at = now;
    }
    frame answer = {.size = HEADER};
    PUT(&answer, command, 2, result, 1, 0, 1, (one && result != UNSUPPORTED) | blocking << 8, 4,
        HOST_SYSTEM, 1, HOST_COMPONENT, 1);
    sent(board, &answer, COMMAND_ACK, 143);
}

static void handle(mb_board *board, uint32_t id, const uint8_t *payload, uint64_t now) {
    advance(board, now);
    if (id == HEARTBEAT) {
        board->heartbeat_at = now;
    } else if (id == TIMESYNC && get(payload, 8) == 0) {
        frame answer = {.size = HEADER};
        PUT(&answer, 1000 * now, 8, get(payload + 8, 8), 8);
        sent(board, &answer, TIMESYNC, 34);
    } else if (id == ACTUATOR_TARGET) {
        take_target(board, payload, now);
    } else if (id == COMMAND_LONG && get(payload + 30, 2) == BOARD_ADDRESS) {
        obey(board, payload, now);
    }
}

/* Bytes at the front that are done with: a frame, or what cannot begin one; 0: wait for more. */
static size_t parse(mb_board *board, uint64_t now) {
    const uint8_t *held = board->held;
    const size_t size = board->held_size;
    if ((size > 0 && held[0] != MARKER) || (size > 2 && held[2] != 0))     /* incompat_flags */
        return 1;
    if (size < HEADER)
        return 0;
    const uint32_t id = (uint32_t)get(held + 7, 3);
    const int extra = extra_of(id);
    const size_t length = held[1], whole = HEADER + length + CHECKSUM;
    if (extra < 0)
        return 1;
    if (size < whole)
        return 0;
    if (crc_of(held + 1, HEADER - 1 + length, extra) != get(held + HEADER + length, CHECKSUM)) {
        board->bad_checksums++;
        return 1;
    }
    if (held[5] == HOST_SYSTEM && held[6] == HOST_COMPONENT) {
        if (board->peer_known)
            board->lost += (uint8_t)(held[4] - board->peer_sequence - 1);
        board->peer_known = true;
        board->peer_sequence = held[4];
        uint8_t payload[LONGEST_READ] = {0};
        memcpy(payload, held + HEADER, length < sizeof payload ? length : sizeof payload);
        handle(board, id, payload, now);
    }
    return whole;
}

void mb_receive(mb_board *board, const uint8_t *bytes, size_t size, uint64_t now) {
    board->received_at = (uint32_t)(now & UINT32_MAX);
    for (size_t k = 0; k < size && board->announced; k++) {
        board->held[board->held_size++] = bytes[k];
        for (size_t done; (done = parse(board, now)) > 0;) {
            board->held_size -= done;
            memmove(board->held, board->held + done, board->held_size);
        }
    }
}

/* --- messages to the computer, section 5 ----------------------------------------------------- */

static int32_t limited(int32_t value, int32_t low, int32_t high) {
    return value < low ? low : value > high ? high : value;
}

void mb_battery(mb_board *board, int32_t millivolts, int32_t centiamperes) {
    board->millivolts = limited(millivolts, MB_UNKNOWN, UINT16_MAX - 1);
    board->centiamperes = limited(centiamperes, INT16_MIN, INT16_MAX);
}

void mb_telemetry(mb_board *board, unsigned rotor, const mb_reading *reading, uint64_t now) {
    board->escs[rotor].reading = *reading;
    board->escs[rotor].heard_at = board->measured_at = now;
    board->esc_packets++;
}

static const mb_reading no_reading = {.centidegrees = NO_TEMPERATURE};

/* Find ESCs that are offline or failed; return whether that changed since the last ESC_INFO. */
static bool check_escs(mb_board *board, uint64_t now) {
    bool changed = false;
    const mb_output *output = &board->outputs[board->shown];
    for (unsigned k = 0; k < MB_ROTORS && board->numbers.esc_telemetry; k++) {
        mb_esc *esc = &board->escs[k];
        const uint16_t before = esc->failures;
        const bool heard = within(esc->heard_at, now, ESC_SILENCE);
        if (now >= output->until || output->pulses[k] == MB_STOP || esc->reading.rpm != 0)
            esc->turned_at = now;
        esc->online = heard && within(esc->turned_at, now, ESC_START);
        esc->failures = esc->online ? esc->reading.failures : heard ? STUCK : GENERIC;
        esc->errors += !before && esc->failures;
        if (!esc->online)
            esc->reading = no_reading;
        changed = changed || esc->sent != (esc->failures | (uint32_t)esc->online << 16);
    }
    return changed;
}

static bool send_heartbeat(mb_board *board, unsigned state, uint64_t now) {
    const unsigned conditions = mb_conditions(board, now);
    const bool armed = state >= MB_ARMED;
    const uint32_t mode = state | (uint32_t)board->stop_reason << 8 | conditions << 16
        | (uint32_t)CONTRACT_VERSION << 24;
    const bool changed = mode != board->sent_mode && now - board->sent_at >= HEARTBEAT_SPACING;
    if (state != MB_BOOT && now < board->next[MB_HEARTBEAT] && !changed)
        return false;
    frame made = {.size = HEADER};
    PUT(&made, mode, 4, 2, 1, 0, 1, armed ? 129 : 1, 1,
        state == MB_BOOT ? 1 : conditions & MB_ESC_FAILURE ? 5 : armed ? 4 : 3, 1, 3, 1);
    if (!sent(board, &made, HEARTBEAT, 50))
        return false;
    board->sent_mode = mode;
    board->sent_at = now;
    return true;
}

static void send_info(mb_board *board, uint64_t now) {
    frame made = {.size = HEADER};
    mb_esc *escs = board->escs;
    uint64_t online = 0;
    PUT(&made, now, 8);
    for (unsigned k = 0; k < MB_ROTORS; k++)
        PUT(&made, escs[k].errors, 4);
    PUT(&made, board->esc_packets, 2);
    for (unsigned k = 0; k < MB_ROTORS; k++)
        PUT(&made, escs[k].failures, 2);
    for (unsigned k = 0; k < MB_ROTORS; k++) {
        PUT(&made, escs[k].reading.centidegrees, 2);
        online |= (uint64_t)escs[k].online << k;
    }
    PUT(&made, 0, 1, MB_ROTORS, 1, 0, 1, online, 1);
    const bool done = sent(board, &made, ESC_INFO, 251);
    for (unsigned k = 0; k < MB_ROTORS && done; k++)
        escs[k].sent = escs[k].failures | (uint32_t)escs[k].online << 16;
}

static void send_rotors(mb_board *board, uint64_t now) {
    frame made = {.size = HEADER};
    const mb_esc *escs = board->escs;
    PUT(&made, board->measured_at != NEVER ? board->measured_at : now, 8);
    for (unsigned k = 0; k < MB_ROTORS; k++)
        PUT(&made, (uint32_t)escs[k].reading.rpm, 4);
    for (unsigned k = 0; k < MB_ROTORS; k++)
        put_thousandth(&made, escs[k].reading.millivolts);
    for (unsigned k = 0; k < MB_ROTORS; k++)
        put_thousandth(&made, escs[k].reading.milliamperes);
    PUT(&made, 0, 1);
    sent(board, &made, ESC_STATUS, 10);
}

static void send_battery(mb_board *board) {
    frame made = {.size = HEADER};
    PUT(&made, UINT64_MAX, 8, NO_TEMPERATURE, 2, (uint16_t)board->millivolts, 2,
        UINT64_MAX, 8, UINT64_MAX, 8, UINT16_MAX, 2, (uint16_t)board->centiamperes, 2,
        1U << 16, 3, UINT8_MAX, 1);     /* of one pack of type LiPo */
    sent(board, &made, BATTERY_STATUS, 154);
}

static void send_reception(mb_board *board) {
    uint32_t refused = 0;
    for (unsigned k = 0; k < MB_REFUSALS; k++)
        refused += board->refused[k];
    const uint32_t counts[] = {board->lost + board->bad_checksums, board->lost,
                               board->bad_checksums, refused, board->timeouts};
    frame made = {.size = HEADER};
    PUT(&made, 0, 14, (uint16_t)board->millivolts, 2, (uint16_t)board->centiamperes, 2, 0, 2);
    for (unsigned k = 0; k < 5; k++)
        PUT(&made, counts[k] < UINT16_MAX ? counts[k] : UINT16_MAX, 2);
    PUT(&made, UINT8_MAX, 1);
    sent(board, &made, SYS_STATUS, 124);
}

/* Whether a message is due: without drift, and once after a pause. */
static bool due(mb_board *board, unsigned message, uint64_t now) {
    const uint32_t period = board->numbers.periods[message];
    uint64_t *next = &board->next[message];
    const bool reached = now >= *next;
    if (reached)
        *next += period * (1 + (now - *next) / period);
    return reached;
}

bool mb_step(mb_board *board, uint64_t now) {
    const uint32_t low = (uint32_t)(now & UINT32_MAX);
    const bool alive = low - board->received_at < ALIVE && low - board->pulses_at < ALIVE;
    advance(board, now);
    const bool escs_changed = check_escs(board, now);
    if (!board->announced) {
        board->announced = now >= board->booted_at && send_heartbeat(board, MB_BOOT, now);
        return alive;
    }
    if (send_heartbeat(board, mb_state(board, now), now))
        due(board, MB_HEARTBEAT, now);
    if (due(board, MB_ESC_INFO, now) || escs_changed)
        send_info(board, now);
    if (due(board, MB_ESC_STATUS, now))
        send_rotors(board, now);
    if (due(board, MB_BATTERY_STATUS, now))
        send_battery(board);
    if (due(board, MB_SYS_STATUS, now))
        send_reception(board);
    return alive;
}

/* --- outputs --------------------------------------------------------------------------------- */

void mb_pulses(mb_board *board, uint64_t now, uint32_t pulses[MB_ROTORS]) {
    const mb_output *output = &board->outputs[board->shown];
    for (unsigned k = 0; k < MB_ROTORS; k++)
        pulses[k] = now < output->until ? output->pulses[k] : (uint32_t)MB_STOP;
    board->pulses_at = (uint32_t)(now & UINT32_MAX);
}

uint16_t mb_dshot(uint32_t pulse, bool telemetry) {
    const uint32_t share = pulse < MB_STOP ? 0 : pulse > 2 * MB_STOP ? MB_STOP : pulse - MB_STOP;
    const uint32_t throttle = share ? 48 + (1999 * share + MB_STOP / 2) / MB_STOP : 0;
    const uint32_t value = throttle << 1 | telemetry;
    return (uint16_t)(value << 4 | ((value ^ value >> 4 ^ value >> 8) & 0xF));
}

void mb_reset(mb_board *board, const mb_numbers *numbers, mb_send *send, void *context,
              bool by_watchdog, uint64_t now) {
    const uint32_t low = (uint32_t)(now & UINT32_MAX);
    *board = (mb_board){
        .numbers = *numbers, .send = send, .context = context, .heartbeat_at = NEVER,
        .thrust_at = NEVER, .target_at = NEVER, .measured_at = NEVER, .received_at = low,
        .pulses_at = low, .millivolts = MB_UNKNOWN, .centiamperes = MB_UNKNOWN,
        .stop_reason = by_watchdog ? MB_WATCHDOG : MB_NONE,
        .booted_at = now + numbers->boot_time};
    for (unsigned k = 0; k < MB_MESSAGES; k++)
        board->next[k] = board->booted_at;
    for (unsigned k = 0; k < MB_ROTORS; k++) {
        board->escs[k] = (mb_esc){.reading = no_reading, .heard_at = NEVER, .turned_at = now,
                                  .online = !numbers->esc_telemetry};
    }
}
