#include <string.h>
#include "os_type.h"
#include "user_config.h"
#define os_memcpy ets_memcpy
#define os_memset ets_memset
#define os_strlen ets_strlen
#define os_timer_disarm ets_timer_disarm
#define os_timer_setfn ets_timer_setfn
#define os_install_putc1 ets_install_putc1
#ifdef USE_US_TIMER
#define os_timer_arm_us(timer, time_us, repeat) ets_timer_arm_new(timer, time_us, repeat, 0)
#endif
void *ets_memcpy(void *to, const void *from, unsigned len);
void *ets_memset(void *to, int value, unsigned len);
int ets_strlen(const char *text);
void ets_timer_arm_new(os_timer_t *timer, uint32_t time, bool repeat, bool in_milliseconds);
void ets_timer_disarm(os_timer_t *timer);
void ets_timer_setfn(os_timer_t *timer, os_timer_func_t *function, void *argument);
void ets_install_putc1(void (*put)(char letter));
unsigned long os_random(void);
