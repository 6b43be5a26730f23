/* C library functions that the SDK's lwIP needs and the chip's ROM lacks. Only parts of lwIP that the bridge
 * never calls use them, but they are correct. */

#include "sdk.h"

void *ICACHE_FLASH_ATTR memchr(const void *bytes, int wanted, size_t len)
{
    const uint8_t *at = bytes;
    for (; len; at++, len--)
        if (*at == (uint8_t)wanted)
            return (void *)at;
    return NULL;
}

/* Newlib's <ctype.h>, which the SDK was compiled with: character classes, EOF (-1) first. */
enum { UPPER = 1, LOWER = 2, DIGIT = 4, SPACE = 8, PUNCTUATION = 16, CONTROL = 32, HEX = 64, BLANK = 128 };

static const uint8_t kinds[257] ICACHE_RODATA_ATTR STORE_ATTR = {
    [1 + 0 ... 1 + 8] = CONTROL,
    [1 + '\t' ... 1 + '\r'] = CONTROL | SPACE,
    [1 + 14 ... 1 + 31] = CONTROL,
    [1 + ' '] = SPACE | BLANK,
    [1 + '!' ... 1 + '/'] = PUNCTUATION,
    [1 + '0' ... 1 + '9'] = DIGIT,
    [1 + ':' ... 1 + '@'] = PUNCTUATION,
    [1 + 'A' ... 1 + 'F'] = UPPER | HEX,
    [1 + 'G' ... 1 + 'Z'] = UPPER,
    [1 + '[' ... 1 + '`'] = PUNCTUATION,
    [1 + 'a' ... 1 + 'f'] = LOWER | HEX,
    [1 + 'g' ... 1 + 'z'] = LOWER,
    [1 + '{' ... 1 + '~'] = PUNCTUATION,
    [1 + 127] = CONTROL,
};

const uint8_t *__ctype_ptr__ = kinds;
