/* Counters of the core's reads of constants. */
#ifndef VIZFLYT_CONSTANTS_H
#define VIZFLYT_CONSTANTS_H

#include <stdint.h>

struct constant_loads {
    uint32_t narrow; /* bytes and halves: exceptions on the chip */
    uint32_t words;  /* ordinary instructions on the chip */
};

extern struct constant_loads constant_loads;

/* Stops the emulator after an access that would crash the chip. */
void constant_fault(void) __attribute__((noreturn));

#endif
