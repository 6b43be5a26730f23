/* Emulates the chip's reads from flash: the core's constants lie at addresses without memory. On the chip, a
 * whole-word load from flash is an ordinary instruction; narrower loads are exceptions, handled by the SDK's
 * load_non_32_wide_handler (l8ui, l16ui and l16si). Here every load is an exception, so that all are counted.
 * Stores and unaligned loads stop the emulator, because they would crash the chip. */

#include <stdint.h>

#include "constants.h"

extern const uint8_t _constants[], _constants_end[], _constants_shadow[];

uint32_t constant_registers[17];
uint32_t constant_stack[64];
__asm__(".global constant_stack_top\nconstant_stack_top = constant_stack + 256");

struct constant_loads constant_loads;

uint32_t constant_load(uint32_t *registers, uint32_t at, uint32_t address)
{
    /* An instruction has two or three bytes at any address: two words contain it. */
    const uint32_t *words = (const uint32_t *)(at & ~3u);
    uint32_t shift = at % 4 * 8;
    uint32_t code = shift ? words[0] >> shift | words[1] << (32 - shift) : words[0];
    uint32_t to = code >> 4 & 15;

    if (address < (uint32_t)_constants || address >= (uint32_t)_constants_end || to == 1)
        constant_fault();
    const uint8_t *shadow = _constants_shadow + (address - (uint32_t)_constants);
    uint32_t word = *(const uint32_t *)((uint32_t)shadow & ~3u) >> address % 4 * 8;

    if ((code & 0xF) == 0x8 || (code & 0xF00F) == 0x2002) { /* l32i.n, l32i */
        constant_loads.words++;
        if (address % 4)
            constant_fault();
        registers[to] = word;
        return at + ((code & 0xF) == 0x8 ? 2 : 3);
    }
    if ((code & 0xF00F) == 0x0002) { /* l8ui */
        registers[to] = word & 0xFF;
    } else if ((code & 0x700F) == 0x1002 && address % 2 == 0) { /* l16ui, l16si */
        registers[to] = code & 0x8000 ? (uint32_t)(int16_t)word : word & 0xFFFF;
    } else {
        constant_fault();
    }
    constant_loads.narrow++;
    return at + 3;
}
