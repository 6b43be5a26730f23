#ifndef SDK_H
#define SDK_H
typedef unsigned char uint8_t, uint8, bool;
typedef signed char int8_t, sint8;
typedef unsigned short uint16_t, uint16;
typedef signed short int16_t;
typedef unsigned int uint32_t, uint32, size_t;
typedef signed int int32_t;
#define NULL ((void *)0)
#ifdef ICACHE_FLASH
#define ICACHE_FLASH_ATTR __attribute__((section(".irom0.text")))
#define ICACHE_RODATA_ATTR __attribute__((section(".irom.text")))
#endif
#define STORE_ATTR __attribute__((aligned(4)))
#define BIT(n) (1ul << (n))
#define READ_PERI_REG(address) (*(volatile uint32_t *)(address))
#define WRITE_PERI_REG(address, value) (*(volatile uint32_t *)(address)) = (uint32_t)(value)
#define CLEAR_PERI_REG_MASK(address, mask) WRITE_PERI_REG(address, READ_PERI_REG(address) & ~(mask))
#define SET_PERI_REG_MASK(address, mask) WRITE_PERI_REG(address, READ_PERI_REG(address) | (mask))
#define UART_CLK_FREQ (80 * 1000000)
#define PERIPHS_IO_MUX_U0TXD_U 0x60000818
#define PERIPHS_IO_MUX_U0RXD_U 0x60000814
#define PERIPHS_IO_MUX_MTDO_U 0x60000810
#define PERIPHS_IO_MUX_MTCK_U 0x60000808
#define PERIPHS_IO_MUX_GPIO2_U 0x60000838
#define FUNC_U0TXD 0
#define FUNC_U0RTS 4
#define FUNC_GPIO2 0
#define PIN_PULLUP_DIS(pin) CLEAR_PERI_REG_MASK(pin, BIT(7))
#define PIN_PULLUP_EN(pin) SET_PERI_REG_MASK(pin, BIT(7))
#define PIN_FUNC_SELECT(pin, function) do { WRITE_PERI_REG(pin, (function) << 4); } while (0)
typedef struct { uint32_t sig, par; } ETSEvent;
typedef void (*ETSTask)(ETSEvent *event);
typedef void ETSTimerFunc(void *argument);
typedef struct Timer { struct Timer *next; uint32_t expire, period; ETSTimerFunc *function; void *argument; } ETSTimer;
typedef void (*ets_isr_t)(void *argument);
#define ETS_UART_INUM 5
#define ETS_UART_INTR_ATTACH(function, argument) ets_isr_attach(ETS_UART_INUM, (function), (void *)(argument))
#define ETS_UART_INTR_ENABLE() ets_isr_unmask(1 << ETS_UART_INUM)
#define ETS_UART_INTR_DISABLE() ets_isr_mask(1 << ETS_UART_INUM)
void ets_isr_attach(int number, ets_isr_t function, void *argument);
void ets_isr_mask(uint32 mask);
void ets_isr_unmask(uint32 mask);
#endif
