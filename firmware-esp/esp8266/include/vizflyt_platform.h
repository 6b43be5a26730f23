/* Interface between the bridge (Rust, the same object for every use) and its platform: QEMU's semihosting in
 * tests (qemu/platform.c), or the vendor's NONOS SDK on the chip (sdk/).
 *
 * One thread of control: vizflyt_start and vizflyt_poll are never called from an interrupt or from within a
 * platform_ function. Interrupts only record events; the main loop then passes them as `events` of
 * vizflyt_poll. */
#ifndef VIZFLYT_PLATFORM_H
#define VIZFLYT_PLATFORM_H

#include <stdint.h>

/* --- functions of the Rust side */

/* Events since the last poll; several are combined with or. */
enum {
    VIZFLYT_UART_READABLE = 1, /* platform_uart_read would return bytes */
    VIZFLYT_UART_WRITABLE = 2, /* platform_uart_write would take bytes */
    VIZFLYT_FRAMES = 4,        /* a frame was received, or one can be sent again */
    VIZFLYT_LINK = 8,          /* platform_link_up may have changed */
};

/* Starts the network and its tasks. Call it once, before all other functions. */
void vizflyt_start(void);

/* Runs every task that can make progress. Returns the time until the next timer, unless an event comes first
 * [us]; UINT32_MAX if no timer is set. */
uint32_t vizflyt_poll(uint32_t events);

/* --- functions of the platform; none blocks */

/* Microseconds since an arbitrary start; wraps. Read at least once in 2^31 us. */
uint32_t platform_time_us(void);
/* Disables interrupts; returns the argument for platform_interrupts_restore. Nests. */
uint32_t platform_interrupts_off(void);
void platform_interrupts_restore(uint32_t state);
/* 32 random bits, good enough for port numbers and the seed of nonces. */
uint32_t platform_random(void);
/* Requests a call of vizflyt_poll soon. May be called from anywhere, also from within vizflyt_poll. */
void platform_wake(void);
/* Called for a fatal error of the core: restarts the chip, or stops the emulator. There is no message,
 * because texts would cost RAM. */
void abort(void) __attribute__((noreturn));
/* Restarts the chip. */
void platform_restart(void) __attribute__((noreturn));

/* Copies up to `len` received bytes; returns their number. */
uint32_t platform_uart_read(uint8_t *into, uint32_t len);
/* Queues bytes to send; returns the number of accepted bytes. */
uint32_t platform_uart_write(const uint8_t *bytes, uint32_t len);
/* Whether all accepted bytes were sent. */
uint32_t platform_uart_is_idle(void);
/* Number of overruns, each of which lost received bytes. Never reset. */
uint32_t platform_uart_overruns(void);
/* Sets the rate [baud] and flow control by RTS and CTS. Bytes in transmission are finished first. */
void platform_uart_configure(uint32_t baud, uint32_t flow_control);

/* Address of the station or access point. */
void platform_mac(uint8_t into[6]);
/* Oldest received Ethernet frame, and its length without checksum; NULL if there is none. The frame stays in
 * place, and may be modified, until platform_frame_done releases it. */
uint8_t *platform_frame_waiting(uint32_t *len);
void platform_frame_done(void);
/* Buffer for one Ethernet frame to send, 1514 bytes; NULL if none can be sent now. Only one buffer exists
 * until it is sent or dropped. */
uint8_t *platform_frame_begin(void);
void platform_frame_send(uint32_t len);
void platform_frame_drop(void);
/* Joins a network, or stops joining and opens one. Texts end with a zero; an empty password means an open
 * network. */
int32_t platform_wifi_station(const char *ssid, const char *password);
int32_t platform_wifi_access_point(const char *ssid, const char *password, uint32_t channel);
/* Whether the radio has joined a network (station) or opened one (access point). */
uint32_t platform_link_up(void);
/* Signal strength of the joined access point [dBm]; 0 if unknown. */
int32_t platform_rssi_dbm(void);

/* The LED: 0 off, 1 on. */
void platform_led(uint32_t on);

/* Flash access: addresses from its start, multiples of 4; sectors of 4096 bytes. Return 0 on success. */
int32_t platform_flash_read(uint32_t address, uint8_t *into, uint32_t len);
int32_t platform_flash_write(uint32_t address, const uint8_t *bytes, uint32_t len);
int32_t platform_flash_erase(uint32_t sector);

#endif
