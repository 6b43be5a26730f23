/* Serial line to the autopilot: UART0 on its default pins, GPIO1 out, GPIO3 in; GPIO15 RTS, GPIO13 CTS. */

#include "sdk.h"

enum { FIFO = 128, RX_INTERRUPT_AT = 32, RX_PAUSE_AT = 100, TX_INTERRUPT_AT = 16 };
enum { RX_INTERRUPTS = UART_RXFIFO_FULL_INT_ENA | UART_RXFIFO_TOUT_INT_ENA | UART_RXFIFO_OVF_INT_ENA };

/* The rings lie in free instruction RAM, which only supports whole-word accesses (volatile keeps the compiler
 * to them). Each ring has one writer. The # hides the compiler's own section flags, which are those of data. */
#define IN_INSTRUCTION_RAM __attribute__((section(".text.rings, \"ax\", @progbits #")))
static volatile uint32_t rx_ring[UART_IN / 4] IN_INSTRUCTION_RAM = {0};
static volatile uint32_t tx_ring[UART_OUT / 4] IN_INSTRUCTION_RAM = {0};
static volatile uint32_t rx_in, rx_out, tx_in, tx_out; /* never reset */
static volatile uint32_t overruns;

static inline void put(volatile uint32_t *ring, uint32_t at, uint8_t byte)
{
    uint32_t shift = at % 4 * 8;
    ring[at / 4] = (ring[at / 4] & ~(0xFFu << shift)) | (uint32_t)byte << shift;
}

static inline uint8_t get(const volatile uint32_t *ring, uint32_t at)
{
    return ring[at / 4] >> at % 4 * 8;
}

static uint32_t fifo_in(void)
{
    return (READ_PERI_REG(UART_STATUS(0)) >> UART_RXFIFO_CNT_S) & UART_RXFIFO_CNT;
}

static uint32_t fifo_out(void)
{
    return (READ_PERI_REG(UART_STATUS(0)) >> UART_TXFIFO_CNT_S) & UART_TXFIFO_CNT;
}

/* Requires that interrupts are off, or that the interrupt is the caller. */
static void drain(void)
{
    while (fifo_in() && rx_in - rx_out < UART_IN)
        put(rx_ring, rx_in++ % UART_IN, READ_PERI_REG(UART_FIFO(0)) & 0xFF);
    /* A full ring leaves the rest in the hardware, which pauses the autopilot if RTS is wired. Reading enables
     * the interrupts again. Bytes lost until then count as one overrun. */
    if (rx_in - rx_out == UART_IN)
        CLEAR_PERI_REG_MASK(UART_INT_ENA(0), RX_INTERRUPTS);
}

static void refill(void)
{
    while (fifo_out() < FIFO - 2 && tx_in != tx_out)
        WRITE_PERI_REG(UART_FIFO(0), get(tx_ring, tx_out++ % UART_OUT));
    if (tx_in == tx_out)
        CLEAR_PERI_REG_MASK(UART_INT_ENA(0), UART_TXFIFO_EMPTY_INT_ENA);
}

static void on_uart(void *unused)
{
    (void)unused;
    uint32_t status = READ_PERI_REG(UART_INT_ST(0)), events = 0;
    if (status & UART_RXFIFO_OVF_INT_ST)
        overruns++;
    if (status & (UART_RXFIFO_FULL_INT_ST | UART_RXFIFO_TOUT_INT_ST | UART_RXFIFO_OVF_INT_ST)) {
        drain();
        events |= VIZFLYT_UART_READABLE;
    }
    if (status & UART_TXFIFO_EMPTY_INT_ST) {
        refill();
        events |= VIZFLYT_UART_WRITABLE;
    }
    WRITE_PERI_REG(UART_INT_CLR(0), status);
    if (events)
        happened(events);
}

uint32_t platform_uart_read(uint8_t *into, uint32_t len)
{
    uint32_t done = 0;
    while (done < len && rx_out != rx_in)
        into[done++] = get(rx_ring, rx_out++ % UART_IN);
    uint32_t state = platform_interrupts_off();
    drain();
    if (rx_in - rx_out < UART_IN)
        SET_PERI_REG_MASK(UART_INT_ENA(0), RX_INTERRUPTS);
    platform_interrupts_restore(state);
    return done;
}

uint32_t platform_uart_write(const uint8_t *bytes, uint32_t len)
{
    uint32_t done = 0;
    while (done < len && tx_in - tx_out < UART_OUT)
        put(tx_ring, tx_in++ % UART_OUT, bytes[done++]);
    uint32_t state = platform_interrupts_off();
    refill();
    if (tx_in != tx_out)
        SET_PERI_REG_MASK(UART_INT_ENA(0), UART_TXFIFO_EMPTY_INT_ENA);
    platform_interrupts_restore(state);
    return done;
}

uint32_t platform_uart_is_idle(void)
{
    return tx_in == tx_out && fifo_out() == 0;
}

uint32_t platform_uart_overruns(void)
{
    return overruns;
}

void ICACHE_FLASH_ATTR platform_uart_configure(uint32_t baud, uint32_t flow_control)
{
    /* Bytes in the hardware are sent at the old rate: at most 128 bytes, 22 ms at 57600 baud. */
    while (fifo_out())
        system_soft_wdt_feed();
    ETS_UART_INTR_DISABLE();
    WRITE_PERI_REG(UART_INT_ENA(0), 0);
    uart_div_modify(0, UART_CLK_FREQ / baud);

    PIN_PULLUP_DIS(PERIPHS_IO_MUX_U0TXD_U);
    PIN_FUNC_SELECT(PERIPHS_IO_MUX_U0TXD_U, FUNC_U0TXD);
    PIN_PULLUP_EN(PERIPHS_IO_MUX_U0RXD_U);
    PIN_FUNC_SELECT(PERIPHS_IO_MUX_U0RXD_U, FUNC_U0RXD);
    uint32_t conf0 = 3 << UART_BIT_NUM_S | 1 << UART_STOP_BIT_NUM_S; /* 8N1 */
    uint32_t conf1 = RX_INTERRUPT_AT << UART_RXFIFO_FULL_THRHD_S
        | TX_INTERRUPT_AT << UART_TXFIFO_EMPTY_THRHD_S
        | 2 << UART_RX_TOUT_THRHD_S | UART_RX_TOUT_EN;
    if (flow_control) {
        PIN_FUNC_SELECT(PERIPHS_IO_MUX_MTDO_U, FUNC_U0RTS);
        PIN_FUNC_SELECT(PERIPHS_IO_MUX_MTCK_U, FUNC_U0CTS);
        conf0 |= UART_TX_FLOW_EN;
        conf1 |= RX_PAUSE_AT << UART_RX_FLOW_THRHD_S | UART_RX_FLOW_EN;
    }
    WRITE_PERI_REG(UART_CONF0(0), conf0 | UART_RXFIFO_RST | UART_TXFIFO_RST);
    WRITE_PERI_REG(UART_CONF0(0), conf0);
    WRITE_PERI_REG(UART_CONF1(0), conf1);
    WRITE_PERI_REG(UART_INT_CLR(0), 0xFFFF);
    WRITE_PERI_REG(UART_INT_ENA(0), RX_INTERRUPTS);
    ETS_UART_INTR_ATTACH(on_uart, NULL);
    ETS_UART_INTR_ENABLE();
}
