/*
 * Reference of the motor board: protocol, arming, timeouts and output values of the contract
 * docs/reference/firmware.md, without hardware. docs/how-to/firmware.md describes a port.
 *
 * C11, no allocation, no library but memcpy, memmove and memset. Times are microseconds since the
 * reset, from one clock of 64 bits that never steps and that an interrupt may read, too.
 */
#ifndef MOTOR_BOARD_H
#define MOTOR_BOARD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

enum { MB_ROTORS = 4, MB_STOP = 1000000, MB_LONGEST_FRAME = 267, MB_UNKNOWN = -1 };
enum { MB_BOOT, MB_DISARMED, MB_ARMED, MB_RUNNING };            /* states */
enum { MB_NONE, MB_REQUESTED, MB_HEARTBEAT_LOST, MB_NO_TARGET, MB_WATCHDOG };   /* disarmed by */
enum { MB_BOOTING = 1, MB_NO_HEARTBEAT = 2, MB_THROTTLE = 4, MB_BATTERY_LOW = 8,
       MB_ESC_FAILURE = 16, MB_TIMED_OUT = 32, MB_SATURATED = 64, MB_BLOCKS_ARMING = 31 };
/* Why a target was refused, in the order of the checks. */
enum { MB_ADDRESSEE, MB_GROUP, MB_NOT_FINITE, MB_MORE_ROTORS, MB_STALE, MB_FUTURE, MB_OLDER,
       MB_NOT_ARMED, MB_REFUSALS };

enum { MB_HEARTBEAT, MB_BATTERY_STATUS, MB_ESC_STATUS, MB_ESC_INFO, MB_SYS_STATUS, MB_MESSAGES };

/* Section 2 of the contract: times and periods [us], voltage of the pack [mV]. */
typedef struct {
    uint32_t target_timeout, heartbeat_timeout, idle_timeout, throttle_low_time;
    uint32_t target_age_limit, target_future_limit, boot_time, arm_voltage, periods[MB_MESSAGES];
    uint32_t esc_telemetry;             /* 1 if the telemetry wires of the ESCs are connected */
} mb_numbers;

extern const mb_numbers mb_contract;    /* the values of the contract, with telemetry wires */
extern const size_t mb_size;            /* of mb_board, for callers in other languages */

/* One telemetry packet of an ESC. */
typedef struct {
    int32_t rpm;                        /* of the propeller, positive for both spins */
    int32_t millivolts, milliamperes;
    uint16_t centidegrees;              /* 32767: unknown */
    uint16_t failures;                  /* ESC_FAILURE_FLAGS */
} mb_reading;

typedef struct {
    mb_reading reading;
    uint64_t heard_at, turned_at;       /* turned: or was not commanded to */
    uint32_t errors, sent;
    uint16_t failures;
    bool online;
} mb_esc;

typedef struct {                        /* what the interrupt reads */
    uint32_t pulses[MB_ROTORS];
    uint64_t until;
} mb_output;

/* Puts a whole frame into the transmit buffer; false if there is no space. It must not wait. */
typedef bool mb_send(void *context, const uint8_t *frame, size_t size);

/* All fields are private; the counters may be read. */
typedef struct {
    uint32_t lost, bad_checksums, timeouts, refused[MB_REFUSALS];
    mb_numbers numbers;
    mb_send *send;
    void *context;
    uint8_t held[MB_LONGEST_FRAME], sequence, peer_sequence, stop_reason;
    size_t held_size;
    bool peer_known, announced, armed, saturated, executing;
    uint64_t booted_at, heartbeat_at, thrust_at, target_at, active_at, target_stamp, sent_at;
    uint64_t next[MB_MESSAGES], measured_at;
    uint32_t sent_mode, received_at;
    mb_output outputs[2];               /* the interrupt reads one, the other may be written */
    _Atomic uint32_t shown, pulses_at;
    int32_t millivolts, centiamperes;
    mb_esc escs[MB_ROTORS];
    uint16_t esc_packets;
} mb_board;

/* First of all after a reset, with outputs at stop; `numbers` is &mb_contract on a robot. */
void mb_reset(mb_board *board, const mb_numbers *numbers, mb_send *send, void *context,
              bool by_watchdog, uint64_t now);
/* Main loop, at least every 0.5 ms: bytes of the computer since the last call, or none. */
void mb_receive(mb_board *board, const uint8_t *bytes, size_t size, uint64_t now);
/* Main loop: measured voltage and current of the pack; MB_UNKNOWN if there is none. */
void mb_battery(mb_board *board, int32_t millivolts, int32_t centiamperes);
/* Main loop: a telemetry packet of the ESC of rotor 0 to 3 with a valid checksum. */
void mb_telemetry(mb_board *board, unsigned rotor, const mb_reading *reading, uint64_t now);
/* Main loop, at least every 5 ms: timeouts and messages. Refresh the watchdog if it is true. */
bool mb_step(mb_board *board, uint64_t now);
/* Timer interrupt that updates the PWM, at least every 0.5 ms: the pulses [ns], 1 to 2 ms. */
void mb_pulses(mb_board *board, uint64_t now, uint32_t pulses[MB_ROTORS]);
/* Frame of 16 bits for DShot instead of PWM: 0 stop, 48 to 2047, telemetry request, checksum. */
uint16_t mb_dshot(uint32_t pulse, bool telemetry);
/* Main loop: the state, and the bits of the active conditions. */
unsigned mb_state(mb_board *board, uint64_t now);
unsigned mb_conditions(mb_board *board, uint64_t now);

#endif
