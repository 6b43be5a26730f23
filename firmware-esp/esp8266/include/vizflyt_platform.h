/* The seam between the bridge (Rust, the same object for every use) and what carries it: QEMU's
 * semihosting in tests (qemu/platform.c), the vendor's NONOS SDK on the chip (sdk/).
 *
 * One thread of control: vizflyt_start and vizflyt_poll are never called from an interrupt, nor
 * from within a platform_ function. Interrupts may only note that something happened; whoever
 * runs the loop then passes it as `events` of vizflyt_poll. */
#ifndef VIZFLYT_PLATFORM_H
#define VIZFLYT_PLATFORM_H

#include <stdint.h>

/* --- what Rust offers */

/* What happened since the last poll; several at once are or-ed. */
enum {
    VIZFLYT_UART_READABLE = 1, /* platform_uart_read would return bytes */
    VIZFLYT_UART_WRITABLE = 2, /* platform_uart_write would take bytes */
    VIZFLYT_FRAMES = 4,        /* a frame has come, or one can be sent again */
    VIZFLYT_LINK = 8,          /* platform_link_up may have changed */
};

/* Builds the network and its tasks. Once, before everything else. */
void vizflyt_start(void);

/* Runs every task that can make progress. Returns for how long nothing will be due unless an event
 * comes first. [us]; UINT32_MAX: no timer is set. */
uint32_t vizflyt_poll(uint32_t events);

/* --- what the platform offers; none blocks */

/* Microseconds since an arbitrary start; wraps. Read at least once in 2^31 us. */
uint32_t platform_time_us(void);
/* Interrupts off; returns what platform_interrupts_restore takes. Nests. */
uint32_t platform_interrupts_off(void);
void platform_interrupts_restore(uint32_t state);
/* 32 random bits; good enough for ports and nonces' seeds. */
uint32_t platform_random(void);
/* Asks for vizflyt_poll to be called soon. Called from anywhere, also from within vizflyt_poll. */
void platform_wake(void);
/* Where the core gives up (it ends in `abort`, whose text would cost RAM): restarts the chip, or
 * stops the emulator. */
void abort(void) __attribute__((noreturn));
/* Restarts the chip. */
void platform_restart(void) __attribute__((noreturn));

/* Bytes received by the UART: copies up to `len`, returns how many. */
uint32_t platform_uart_read(uint8_t *into, uint32_t len);
/* Bytes to send: returns how many were taken. */
uint32_t platform_uart_write(const uint8_t *bytes, uint32_t len);
/* Whether all that was taken has left. */
uint32_t platform_uart_is_idle(void);
/* How often bytes came faster than they were read, so that some are lost. Counts up for ever. */
uint32_t platform_uart_overruns(void);
/* Sets the rate [baud] and whether RTS and CTS are used; what is under way is finished first. */
void platform_uart_configure(uint32_t baud, uint32_t flow_control);

/* The station's or access point's address. */
void platform_mac(uint8_t into[6]);
/* The received Ethernet frame that has waited longest, and its length without checksum; NULL if none
 * waits. It stays where it is, and may be written to, until platform_frame_done lets it go. */
uint8_t *platform_frame_waiting(uint32_t *len);
void platform_frame_done(void);
/* Room for one Ethernet frame to send, 1514 bytes; NULL if none can be sent now. Until it is sent or
 * dropped there is no other. */
uint8_t *platform_frame_begin(void);
void platform_frame_send(uint32_t len);
void platform_frame_drop(void);
/* Joins a network, or stops trying and opens one. Texts end in a zero; an empty password: open. */
int32_t platform_wifi_station(const char *ssid, const char *password);
int32_t platform_wifi_access_point(const char *ssid, const char *password, uint32_t channel);
/* Whether the radio is joined (station), or open (access point). */
uint32_t platform_link_up(void);
/* Signal strength of the access point that we joined [dBm]; 0: unknown. */
int32_t platform_rssi_dbm(void);

/* The LED: 0 off, 1 on. */
void platform_led(uint32_t on);

/* The flash: addresses from its start, in multiples of 4; erased by sectors of 4096. 0: done. */
int32_t platform_flash_read(uint32_t address, uint8_t *into, uint32_t len);
int32_t platform_flash_write(uint32_t address, const uint8_t *bytes, uint32_t len);
int32_t platform_flash_erase(uint32_t sector);

#endif
