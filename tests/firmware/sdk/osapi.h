#include <string.h>
#include "user_config.h"
#define os_memcmp ets_memcmp
#define os_memcpy ets_memcpy
#define os_memset ets_memset
#define os_strlen ets_strlen
#define os_timer_disarm ets_timer_disarm
#define os_timer_setfn ets_timer_setfn
#define os_install_putc1 ets_install_putc1
unsigned long os_random(void);
