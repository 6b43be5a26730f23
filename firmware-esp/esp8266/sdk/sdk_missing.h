/* What the SDK's libraries and ROM define and its headers do not declare, or only for some versions. */
#ifndef VIZFLYT_SDK_MISSING_H
#define VIZFLYT_SDK_MISSING_H

void ets_timer_arm_new(ETSTimer *timer, uint32_t time, uint32_t repeat, uint32_t in_milliseconds);
void ets_timer_disarm(ETSTimer *timer);
void ets_timer_setfn(ETSTimer *timer, ETSTimerFunc *function, void *argument);
void ets_isr_attach(int number, void *function, void *argument);
void ets_isr_mask(unsigned mask);
void ets_isr_unmask(unsigned mask);
void ets_install_putc1(void *function);
int ets_memcmp(const void *a, const void *b, unsigned len);
void *ets_memcpy(void *to, const void *from, unsigned len);
void *ets_memset(void *to, int value, unsigned len);
int ets_strlen(const char *text);
void uart_div_modify(uint8 uart, uint32 divisor);

#ifndef FUNC_U0RXD
#define FUNC_U0RXD 0
#endif
#ifndef FUNC_U0CTS
#define FUNC_U0CTS 4
#endif

#endif
