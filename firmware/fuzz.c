/*
 * Frames, valid and damaged, noise, pauses and telemetry, chosen by the bytes of an input, against
 * properties that hold for each input. `fuzz SEED SECONDS` makes random inputs, at least 200.
 */
#include "motor_board.c"

#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { EVENT = 6, EVENTS = 1500 };
static unsigned long long steps[4], frames, dropped, refused[MB_REFUSALS];
static uint8_t expected, full;

#define HOLDS(condition) if (!(condition)) { fputs("not so: " #condition "\n", stderr); abort(); }

static bool collect(void *context, const uint8_t *bytes, size_t size) {
    (void)context;
    HOLDS(bytes[0] == MARKER && size == HEADER + CHECKSUM + (size_t)bytes[1]);
    HOLDS(bytes[4] == expected && (bytes[1] == 1 || bytes[size - 3] != 0));
    return full ? dropped++, false : (frames++, expected++, true);
}

/* A frame of the computer: event[1] is its damage, event[2] to event[4] are its content. */
static size_t compose(uint8_t *bytes, const uint8_t *event, uint64_t now) {
    static const uint32_t ids[] = {ACTUATOR_TARGET, HEARTBEAT, COMMAND_LONG, TIMESYNC};
    static const uint64_t sizes[] = {43, 9, 33, 16}, ages[] = {0, 0, 0, 40000, 150000, 40000};
    static const uint32_t values[] = {0x3F000000, 0x3F800000, 0, 0x80000000, 0x40000000,
                                      0xBF800000, 0x7FC00000, 1};
    static uint64_t stamp;
    static uint8_t sequence;
    const unsigned kind = event[0] & 3, damage = event[1], choice = event[3], odd = event[4];
    const uint64_t length = damage == 250 ? choice : sizes[kind];
    frame made = {.size = 0}, end = {.size = 0};
    uint8_t body[256] = {0};
    if (kind == 0) {
        stamp = event[2] < 200 ? now - ages[event[2] % 6] : event[2] < 220 ? now + 300U * event[2]
            : stamp;
        PUT(&made, stamp, 8);
        for (unsigned k = 0; k < 5; k++)
            PUT(&made, k == 4 ? (odd == 64) * values[choice & 7]
                : values[odd < 64 ? odd >> k & 7 : choice >> k & 1], 4);
        memcpy(body + 40, (uint8_t[]){odd == 65, 1 + (odd == 66), 1 + (odd == 67)}, 3);
    } else if (kind == 2) {
        PUT(&made, values[odd < 32 ? odd & 7 : choice > 30 ? 1 : 2], 4, odd == 64, 4);
        memcpy(body + 28, (uint8_t[]){0x90, odd != 65, 1 + (odd == 66), 1 + (odd == 67)}, 4);
    } else if (kind == 3) {
        PUT(&made, odd < 32, 8, choice, 8);
    }
    memcpy(body, made.bytes, made.size);
    sequence = (uint8_t)(sequence + (damage == 249 ? 7 : 1));
    made.size = 0;
    PUT(&made, MARKER, 1, length, 1, damage == 254, 1, 0, 1, sequence, 1,
        HOST_SYSTEM + (damage == 251), 1, HOST_COMPONENT + (damage == 252), 1,
        damage == 255 ? 300 : ids[kind], 3);
    memcpy(bytes, made.bytes, HEADER);
    memcpy(bytes + HEADER, body, length);
    PUT(&end, crc_of(bytes + 1, HEADER - 1 + length, extra_of(ids[kind])) ^ (damage == 248),
        CHECKSUM);
    memcpy(bytes + HEADER + length, end.bytes, CHECKSUM);
    return damage == 253 ? choice % (HEADER + length) : HEADER + length + CHECKSUM;
}

static void run(const uint8_t *event, size_t count, unsigned variant) {
    mb_board *board = malloc(sizeof *board);    /* the sanitizer sees accesses beyond it */
    mb_numbers numbers = mb_contract;
    uint64_t now = 5, called = now, fed = 0;
    uint32_t pulses[MB_ROTORS];
    expected = 0;
    numbers.esc_telemetry = variant % 8 != 0;
    numbers.idle_timeout = variant & 2 ? 50000 : numbers.idle_timeout;
    mb_reset(board, &numbers, collect, NULL, variant & 1, now);
    for (; count > 0; count--, event += EVENT) {
        const unsigned kind = event[0];
        uint8_t bytes[MB_LONGEST_FRAME];
        const size_t size = kind < 200 ? compose(bytes, event, now) : kind < 210 ? EVENT : 0;
        full = event[5] > 250;
        if (kind < 240) {
            mb_receive(board, kind < 200 ? bytes : event, size, now);
            called = now;
        }
        fed = size ? now : fed;
        if (kind < 4 || kind == 255)
            mb_battery(board, kind ? 24000 : 300 * event[1] - 2000, 300 * event[2]);
        const mb_reading reading = {.rpm = variant & 4 ? 0 : event[1] & 0xF0,
                                    .failures = kind == 230};
        for (unsigned k = 0; k < MB_ROTORS && kind != 231 && numbers.esc_telemetry; k++)
            mb_telemetry(board, k, &reading, now);
        if (kind != 232)
            mb_pulses(board, now, pulses);
        const bool alive = mb_step(board, now);
        HOLDS(alive ? now - called < ALIVE : kind == 232 || now - called >= ALIVE);
        mb_pulses(board, now, pulses);
        const unsigned state = mb_state(board, now);
        steps[state]++;
        for (unsigned rotor = 0; rotor < MB_ROTORS; rotor++) {
            HOLDS(pulses[rotor] >= MB_STOP && pulses[rotor] <= 2 * MB_STOP);
            HOLDS(pulses[rotor] == MB_STOP || (state == MB_RUNNING && now - fed < 100000));
            HOLDS(mb_dshot(pulses[rotor] * (kind & 3), true) >> 5 <= 2047);
        }
        now += kind > 250 ? 10000U * event[5] : event[5] * 80U;
    }
    for (unsigned k = 0; k < MB_REFUSALS; k++)
        refused[k] += board->refused[k];
    free(board);
}

int main(int count, char **arguments) {
    uint64_t state = count > 1 ? strtoull(arguments[1], NULL, 10) : 1;
    const time_t end = time(NULL) + (count > 2 ? atoi(arguments[2]) : 0);
    unsigned inputs = 0;
    for (; inputs < 200 || time(NULL) < end; inputs++) {
        static uint8_t data[EVENT * EVENTS];
        for (size_t k = 0; k < sizeof data; k++) {
            state = state * 6364136223846793005U + 1442695040888963407U;
            data[k] = (uint8_t)(state >> 56);
        }
        run(data, EVENTS, inputs);
    }
    printf("fuzz: %u inputs of %d events; in boot %llu, disarmed %llu, armed %llu, running %llu; "
           "%llu frames sent, %llu dropped; refused", inputs, EVENTS, steps[0], steps[1], steps[2],
           steps[3], frames, dropped);
    for (unsigned k = 0; k < MB_REFUSALS; k++)
        printf(" %llu", refused[k]);
    return puts("") == EOF;
}
