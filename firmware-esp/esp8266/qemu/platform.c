/* Platform of the bridge in QEMU: frames, serial line and flash are file descriptors of the emulator's
 * process, opened by the process that starts it. Reads return at once (the descriptors are non-blocking); the
 * main loop waits if nothing is due. */

#include "../include/vizflyt_platform.h"
#include "constants.h"

int simcall(int number, int a, int b, int c);
uint32_t cycles(void);
int simcall_error;

enum { SYS_EXIT = 1, SYS_READ = 3, SYS_WRITE = 4, SYS_LSEEK = 19, SYS_SELECT_ONE = 29 };
enum { SELECT_READ = 1 };
enum { EAGAIN = 11 };

/* File descriptors: an AF_UNIX socket with one Ethernet frame per packet, a raw pty, a file. */
enum { CONSOLE = 2, FRAMES = 100, SERIAL = 101, FLASH = 102 };

/* QEMU does its I/O by page, and a packet must be one read, so buffers are page-aligned. A received frame has
 * a separate page, because it waits while the first is used. Neither lies in the chip's memory. */
#define EMULATORS_OWN __attribute__((aligned(4096), section(".emulator")))
static uint8_t page[4096] EMULATORS_OWN;
static uint8_t received[4096] EMULATORS_OWN;
static uint32_t received_len;

/* ccount runs at 40 MHz in QEMU's lx106 (its overlay's core frequency), by the emulator's clock: that of the
 * instructions with -icount. Time spent waiting outside is added. */
#define CYCLES_PER_US 40u
static uint32_t waited_us;

static volatile int woken;
static int closed; /* the radio's socket was closed: exit */

static void copy(uint8_t *to, const uint8_t *from, uint32_t len)
{
    while (len--)
        *to++ = *from++;
}

static void stop(int status)
{
    for (;;)
        simcall(SYS_EXIT, status, 0, 0);
}

uint32_t platform_time_us(void)
{
    static uint32_t last, rest, now_us;
    uint32_t at = cycles();
    uint32_t passed = at - last + rest;
    last = at;
    now_us += passed / CYCLES_PER_US;
    rest = passed % CYCLES_PER_US;
    return now_us + waited_us;
}

uint32_t platform_random(void)
{
    /* Xorshift over the clock: only port numbers and identifiers depend on it here. */
    static uint32_t state = 0x9E3779B9;
    state ^= cycles();
    state ^= state << 13;
    state ^= state >> 17;
    state ^= state << 5;
    return state;
}

void platform_wake(void)
{
    woken = 1;
}

static void put_line(const char *line, uint32_t len)
{
    if (len > sizeof page - 1)
        len = sizeof page - 1;
    copy(page, (const uint8_t *)line, len);
    page[len] = '\n';
    simcall(SYS_WRITE, CONSOLE, (int)page, len + 1);
}

/* Fatal error of the core. */
void abort(void)
{
    put_line("abort", 5);
    stop(1);
    __builtin_unreachable();
}

void platform_restart(void)
{
    /* The parent process restarts the emulator. */
    stop(2);
    __builtin_unreachable();
}

uint32_t platform_uart_read(uint8_t *into, uint32_t len)
{
    if (len > sizeof page)
        len = sizeof page;
    int done = simcall(SYS_READ, SERIAL, (int)page, len);
    if (done <= 0)
        return 0;
    copy(into, page, done);
    return done;
}

uint32_t platform_uart_write(const uint8_t *bytes, uint32_t len)
{
    if (len > sizeof page)
        len = sizeof page;
    copy(page, bytes, len);
    int done = simcall(SYS_WRITE, SERIAL, (int)page, len);
    return done < 0 ? 0 : done;
}

uint32_t platform_uart_is_idle(void)
{
    return 1;
}

uint32_t platform_uart_overruns(void)
{
    return 0; /* a pty does not overrun */
}

void platform_uart_configure(uint32_t baud, uint32_t flow_control)
{
    /* A pty has neither. */
    (void)baud;
    (void)flow_control;
}

void platform_mac(uint8_t into[6])
{
    static const uint8_t mac[6] = {0x02, 0x56, 0x46, 0x82, 0x66, 0x01}; /* locally administered */
    copy(into, mac, 6);
}

/* Reads a frame if none waits. Further frames wait in the socket, like in the radio. */
uint8_t *platform_frame_waiting(uint32_t *len)
{
    if (!received_len) {
        int read = simcall(SYS_READ, FRAMES, (int)received, 1514);
        if (read == 0)
            closed = 1;
        received_len = read > 0 ? read : 0;
    }
    *len = received_len;
    return received_len ? received : 0;
}

void platform_frame_done(void)
{
    received_len = 0;
}

/* Separate from the page of other I/O: settings may be read between begin and send. */
static uint8_t sending[4096] EMULATORS_OWN;

uint8_t *platform_frame_begin(void)
{
    return sending;
}

void platform_frame_send(uint32_t len)
{
    /* A full socket: wait, like the radio's own queue. */
    while (simcall(SYS_WRITE, FRAMES, (int)sending, len) < 0)
        if (simcall_error != EAGAIN)
            stop(0);
}

void platform_frame_drop(void)
{
}

int32_t platform_wifi_station(const char *ssid, const char *password)
{
    (void)ssid;
    (void)password;
    return 0;
}

int32_t platform_wifi_access_point(const char *ssid, const char *password, uint32_t channel)
{
    (void)ssid;
    (void)password;
    (void)channel;
    return 0;
}

uint32_t platform_link_up(void)
{
    return 1;
}

int32_t platform_rssi_dbm(void)
{
    return -50;
}

void platform_led(uint32_t on)
{
    (void)on;
}

/* The flash is a file of the chip's size, with the same rule: writes only change bits from 1 to 0. */

int32_t platform_flash_read(uint32_t address, uint8_t *into, uint32_t len)
{
    while (len) {
        uint32_t part = len < sizeof page ? len : sizeof page;
        if (simcall(SYS_LSEEK, FLASH, address, 0) != (int)address ||
            simcall(SYS_READ, FLASH, (int)page, part) != (int)part)
            return -1;
        copy(into, page, part);
        address += part;
        into += part;
        len -= part;
    }
    return 0;
}

int32_t platform_flash_write(uint32_t address, const uint8_t *bytes, uint32_t len)
{
    while (len) {
        uint32_t part = len < sizeof page ? len : sizeof page;
        if (simcall(SYS_LSEEK, FLASH, address, 0) != (int)address ||
            simcall(SYS_READ, FLASH, (int)page, part) != (int)part)
            return -1;
        for (uint32_t i = 0; i < part; i++)
            page[i] &= bytes[i];
        if (simcall(SYS_LSEEK, FLASH, address, 0) != (int)address ||
            simcall(SYS_WRITE, FLASH, (int)page, part) != (int)part)
            return -1;
        address += part;
        bytes += part;
        len -= part;
    }
    return 0;
}

int32_t platform_flash_erase(uint32_t sector)
{
    uint32_t address = sector * sizeof page;
    for (uint32_t i = 0; i < sizeof page; i++)
        page[i] = 0xFF;
    if (simcall(SYS_LSEEK, FLASH, address, 0) != (int)address ||
        simcall(SYS_WRITE, FLASH, (int)page, sizeof page) != (int)sizeof page)
        return -1;
    return 0;
}

void constant_fault(void)
{
    put_line("a load that the chip cannot do", 30);
    stop(3);
    __builtin_unreachable();
}

extern uint32_t _stack_bottom[], _stack_top[];

enum { PAINT = 0xA5A5A5A5 };
/* The chip's stack has 5328 bytes, from 0x3FFFEB30 to the end of its RAM; an interrupt inside an exception
 * adds two frames of 256 bytes. */
enum { STACK = 5328 - 2 * 256 };

/* Appends a number to a text; returns the new length. */
static uint32_t put_number(char *line, uint32_t len, uint32_t value)
{
    for (uint32_t scale = 1000000000; scale; scale /= 10)
        if (value >= scale || scale == 1)
            line[len++] = '0' + value / scale % 10;
    return len;
}

static void report(const char *what, uint32_t len, uint32_t value)
{
    char line[64];
    copy((uint8_t *)line, (const uint8_t *)what, len);
    put_line(line, put_number(line, len, value));
}

/* Returns the maximum depth of the stack since it was painted, and paints it again. */
static uint32_t stack_used(void)
{
    uint32_t *deepest = _stack_bottom;
    while (deepest < _stack_top && *deepest == PAINT)
        deepest++;
    uint32_t used = (uint32_t)_stack_top - (uint32_t)deepest;
    for (uint32_t *here = __builtin_frame_address(0); deepest < here - 32; deepest++)
        *deepest = PAINT;
    if (used > STACK) {
        char line[64] = "deeper than the chip's stack: ";
        uint32_t len = put_number(line, 30, used);
        copy((uint8_t *)line + len, (const uint8_t *)" of ", 4);
        len = put_number(line, len + 4, STACK);
        copy((uint8_t *)line + len, (const uint8_t *)" bytes", 6);
        put_line(line, len + 6);
        stop(4);
    }
    return used;
}

static void report_all(void)
{
    report("stack used afterwards: ", 23, stack_used());
    report("constants read by bytes or halves: ", 35, constant_loads.narrow);
    report("constants read by words: ", 25, constant_loads.words);
}

int main(void)
{
    vizflyt_start();
    report("stack used to start: ", 21, stack_used());
    for (;;) {
        uint32_t len, zero[2] = {0, 0};
        uint32_t events = VIZFLYT_UART_WRITABLE | VIZFLYT_FRAMES;
        if (simcall(SYS_SELECT_ONE, SERIAL, SELECT_READ, (int)zero) > 0)
            events |= VIZFLYT_UART_READABLE;
        woken = 0;
        uint32_t due_us = vizflyt_poll(events);
        if (!platform_frame_waiting(&len) && closed) {
            report_all();
            stop(0);
        }
        if (!woken && !len && !(events & VIZFLYT_UART_READABLE)) {
            /* It cannot wait for the serial line at the same time: check that every 0.2 ms. */
            uint32_t wait[2] = {0, due_us < 200 ? due_us : 200};
            if (simcall(SYS_SELECT_ONE, FRAMES, SELECT_READ, (int)wait) == 0)
                waited_us += wait[1];
        }
    }
}
