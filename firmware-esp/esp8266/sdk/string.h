/* Required by the SDK's headers; Debian's compiler for the chip has no C library headers. */
#ifndef VIZFLYT_STRING_H
#define VIZFLYT_STRING_H

#include <stddef.h>

void *memcpy(void *to, const void *from, size_t len);
void *memmove(void *to, const void *from, size_t len);
void *memset(void *to, int value, size_t len);
int memcmp(const void *a, const void *b, size_t len);
size_t strlen(const char *text);
int strcmp(const char *a, const char *b);
int strncmp(const char *a, const char *b, size_t len);
char *strcpy(char *to, const char *from);
char *strncpy(char *to, const char *from, size_t len);
char *strcat(char *to, const char *from);
char *strchr(const char *text, int letter);
char *strstr(const char *text, const char *part);

#endif
