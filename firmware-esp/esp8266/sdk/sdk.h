/* Common to all files of the shim: the SDK's headers and missing declarations, and the function that passes
 * events to the main loop.
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

/* Declared in netif/wlan_lwip_if.h, among types that no header defines. Returns the SDK's interface
 * STATION_IF or SOFTAP_IF; NULL if it does not exist. */
struct netif *eagle_lwip_getif(uint8 number);

/* Pin functions from the chip's technical reference, appendix 1; the header has only some. */
#ifndef FUNC_U0RXD
#define FUNC_U0RXD 0
#endif
#ifndef FUNC_U0CTS
#define FUNC_U0CTS 4
#endif

/* Sizes of the shim [bytes, unless noted]. */
enum {
    UART_IN = 2048,          /* from the autopilot: 22 ms at 921600 baud; must be a power of two */
    UART_OUT = 512,          /* to the autopilot: 5 ms; must be a power of two */
    FRAMES_WAITING = 4,      /* [frames] received but unread, in the SDK's own buffers */
    FRAME = 1514,            /* an Ethernet frame without its checksum */
    HEAP_LEFT = 8 * 1024,    /* minimum free heap to send a frame: the SDK needs the rest */
    FLASH_AT_ONCE = 64,      /* flash bytes read or written at once, through the stack */
};

/* Passes events of vizflyt_platform.h to the main loop. May be called from anywhere, including interrupts. */
void happened(uint32_t events);
/* Updates the SDK's interfaces, which it recreates when it changes role or joins. */
void radio_hook(void);
/* Initializes the radio; must be called before its other functions. */
void radio_begin(void);

#endif
