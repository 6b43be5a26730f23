/* How often the core has read its constants. */
#ifndef VIZFLYT_CONSTANTS_H
#define VIZFLYT_CONSTANTS_H

#include <stdint.h>

struct constant_loads {
    uint32_t narrow; /* bytes and halves: exceptions on the chip */
    uint32_t words;  /* instructions like any other there */
};

extern struct constant_loads constant_loads;

/* Ends the emulator: what the core did would end the chip. */
void constant_fault(void) __attribute__((noreturn));

#endif
