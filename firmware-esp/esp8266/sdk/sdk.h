/* What the shim's files share: the SDK's headers, what those leave out, and the loop's side of an event.
 *
 * Types are those of SDK 3.0.5: a prototype that differs from its header does not compile. */
#ifndef VIZFLYT_SDK_H
#define VIZFLYT_SDK_H

#include "ets_sys.h"
#include "osapi.h"
#include "os_type.h"
#include "user_interface.h"
#include "spi_flash.h"
#include "gpio.h"
#include "driver/uart_register.h"
#include "lwip/netif.h"
#include "lwip/pbuf.h"

#include "../include/vizflyt_platform.h"

/* netif/wlan_lwip_if.h has it among types that no header defines. The SDK's own station and access
 * point by their numbers, STATION_IF and SOFTAP_IF; NULL while there is none. */
struct netif *eagle_lwip_getif(uint8 number);

/* Functions of the pins by the chip's technical reference, appendix 1; the header has only some. */
#ifndef FUNC_U0RXD
#define FUNC_U0RXD 0
#endif
#ifndef FUNC_U0CTS
#define FUNC_U0CTS 4
#endif

/* Every size of the code around the core. [bytes, where it is not said] */
enum {
    UART_IN = 2048,          /* from the autopilot: 22 ms at 921600 baud; a power of two */
    UART_OUT = 512,          /* to it: 5 ms; a power of two */
    FRAMES_WAITING = 4,      /* [frames] received and not yet read; they lie in the SDK's own buffers */
    FRAME = 1514,            /* an Ethernet frame without its checksum */
    HEAP_LEFT = 8 * 1024,    /* frames being sent lie in the SDK's heap, as do its own needs: below this no more */
    FLASH_AT_ONCE = 64,      /* what is read or written of the flash in one go, over the stack */
};

/* Passes events of vizflyt_platform.h to the loop. From anywhere, interrupts included. */
void happened(uint32_t events);
/* Looks again at the SDK's interfaces, which it makes anew as it changes roles and joins. */
void radio_hook(void);
/* Before everything else of the radio. */
void radio_begin(void);

#endif
