/* The bridge's platform on the chip: the vendor's NONOS SDK underneath.
 *
 * The SDK has the radio, its association and its encryption, and an lwIP that we do not use: each
 * of its interfaces hands received frames to `netif->input`, which is pointed at `on_frame`, and
 * sends what `netif->linkoutput` is given. Everything runs in the SDK's one thread: its timers, its
 * radio callbacks, and one user task, in which the bridge is polled. Nothing here blocks: the SDK's
 * watchdog and its radio want the thread back within milliseconds.
 *
 * Written against the headers of SDK 2.1 to 3.0 (include/, third_party/include/, driver_lib/);
 * functions outside ICACHE_FLASH_ATTR lie in the instruction RAM, because interrupts use them. */

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
#include "sdk_missing.h"

/* --- the flash, 4 MB. Program at 0 and 0x10000 (eagle.app.v6.ld); the SDK's own at its end. */

enum {
    RF_CALIBRATION = 0x3FB000,
    PHY_DATA = 0x3FC000,       /* esp_init_data_default_v08.bin of the SDK goes here */
    SYSTEM_PARAMETERS = 0x3FD000,
};

#ifdef SDK_HAS_PARTITIONS
/* From SDK 3.0 on it asks before anything else. */
static const partition_item_t partitions[] = {
    {SYSTEM_PARTITION_CUSTOMER_BEGIN + 1, 0x00000, 0x10000},
    {SYSTEM_PARTITION_CUSTOMER_BEGIN + 2, 0x10000, 0x5C000},
    {SYSTEM_PARTITION_RF_CAL, RF_CALIBRATION, 0x1000},
    {SYSTEM_PARTITION_PHY_DATA, PHY_DATA, 0x1000},
    {SYSTEM_PARTITION_SYSTEM_PARAMETER, SYSTEM_PARAMETERS, 0x3000},
};

void ICACHE_FLASH_ATTR user_pre_init(void)
{
    /* A refusal leaves nothing that could run; the watchdog restarts the chip. */
    while (!system_partition_table_regist(partitions, sizeof partitions / sizeof partitions[0],
                                          FLASH_SIZE_32M_MAP_512_512)) {
    }
}
#endif

uint32 ICACHE_FLASH_ATTR user_rf_cal_sector_set(void)
{
    return RF_CALIBRATION / SPI_FLASH_SEC_SIZE;
}

/* --- the loop */

enum { TASK = USER_TASK_PRIO_1, QUEUE = 4 };

static os_event_t queue[QUEUE];
static ETSTimer alarm;
static volatile uint32_t pending; /* events, from interrupts and callbacks */
static volatile uint8_t posted;   /* a poll is already asked for */
static uint8_t running;           /* vizflyt_start is done */

uint32_t platform_interrupts_off(void)
{
    uint32_t state;
    __asm__ volatile("rsil %0, 15" : "=a"(state) : : "memory");
    return state;
}

void platform_interrupts_restore(uint32_t state)
{
    __asm__ volatile("wsr %0, ps; rsync" : : "a"(state) : "memory");
}

void platform_wake(void)
{
    uint32_t state = platform_interrupts_off();
    uint8_t ask = !posted;
    posted = 1;
    platform_interrupts_restore(state);
    if (ask && !system_os_post(TASK, 0, 0))
        posted = 0; /* the queue is full: a poll is on its way anyway */
}

static void happened(uint32_t events)
{
    uint32_t state = platform_interrupts_off();
    pending |= events;
    platform_interrupts_restore(state);
    platform_wake();
}

static void ICACHE_FLASH_ATTR on_alarm(void *unused)
{
    (void)unused;
    platform_wake();
}

static void hook(void);

static void ICACHE_FLASH_ATTR run(os_event_t *unused)
{
    (void)unused;
    if (!running)
        return;
    uint32_t state = platform_interrupts_off();
    uint32_t events = pending;
    pending = 0;
    posted = 0;
    platform_interrupts_restore(state);
    hook();
    uint32_t due_us = vizflyt_poll(events | VIZFLYT_FRAMES_SENT);
    os_timer_disarm(&alarm);
    if (due_us != UINT32_MAX) {
        /* The SDK's timer takes 0.1 ms to 134 s. */
        if (due_us < 100)
            due_us = 100;
        if (due_us > 100000000)
            due_us = 100000000;
        ets_timer_arm_new(&alarm, due_us, 0, 0);
    }
}

uint32_t platform_time_us(void)
{
    return system_get_time();
}

uint32_t ICACHE_FLASH_ATTR platform_random(void)
{
    return os_random();
}

void ICACHE_FLASH_ATTR platform_restart(void)
{
    system_restart();
    for (;;) {
        /* It takes effect when this task returns to the SDK, or by the watchdog. */
        system_soft_wdt_feed();
    }
}

/* The core has given up. Why only a restart: both serial ports are taken, the one by the autopilot,
 * the other's pin by the LED. The bridge is back within a second; the autopilot's own failsafe
 * spans that. */
void ICACHE_FLASH_ATTR abort(void)
{
    platform_restart();
}

/* --- the serial line: UART0 on its own pins, GPIO1 out, GPIO3 in; GPIO15 RTS, GPIO13 CTS */

enum { RX_RING = 2048, TX_RING = 512 }; /* powers of two */
enum { FIFO = 128, RX_INTERRUPT_AT = 32, RX_PAUSE_AT = 100, TX_INTERRUPT_AT = 16 };

static uint8_t rx_ring[RX_RING], tx_ring[TX_RING];
static volatile uint32_t rx_in, rx_out, tx_in, tx_out; /* count up for ever */

static uint32_t fifo_in(void)
{
    return (READ_PERI_REG(UART_STATUS(0)) >> UART_RXFIFO_CNT_S) & UART_RXFIFO_CNT;
}

static uint32_t fifo_out(void)
{
    return (READ_PERI_REG(UART_STATUS(0)) >> UART_TXFIFO_CNT_S) & UART_TXFIFO_CNT;
}

/* With interrupts off, or in the interrupt. */
static void drain(void)
{
    while (fifo_in() && rx_in - rx_out < RX_RING)
        rx_ring[rx_in++ % RX_RING] = READ_PERI_REG(UART_FIFO(0)) & 0xFF;
    /* A full ring leaves the rest in the hardware, which pauses the autopilot by RTS where that is
     * wired: reading turns the interrupt on again. */
    if (rx_in - rx_out == RX_RING)
        CLEAR_PERI_REG_MASK(UART_INT_ENA(0), UART_RXFIFO_FULL_INT_ENA | UART_RXFIFO_TOUT_INT_ENA);
}

static void refill(void)
{
    while (fifo_out() < FIFO - 2 && tx_in != tx_out)
        WRITE_PERI_REG(UART_FIFO(0), tx_ring[tx_out++ % TX_RING]);
    if (tx_in == tx_out)
        CLEAR_PERI_REG_MASK(UART_INT_ENA(0), UART_TXFIFO_EMPTY_INT_ENA);
}

static void on_uart(void *unused)
{
    (void)unused;
    uint32_t status = READ_PERI_REG(UART_INT_ST(0)), events = 0;
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
        into[done++] = rx_ring[rx_out++ % RX_RING];
    uint32_t state = platform_interrupts_off();
    drain();
    if (rx_in - rx_out < RX_RING)
        SET_PERI_REG_MASK(UART_INT_ENA(0), UART_RXFIFO_FULL_INT_ENA | UART_RXFIFO_TOUT_INT_ENA);
    platform_interrupts_restore(state);
    return done;
}

uint32_t platform_uart_write(const uint8_t *bytes, uint32_t len)
{
    uint32_t done = 0;
    while (done < len && tx_in - tx_out < TX_RING)
        tx_ring[tx_in++ % TX_RING] = bytes[done++];
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

void ICACHE_FLASH_ATTR platform_uart_configure(uint32_t baud, uint32_t flow_control)
{
    /* What is in the hardware leaves at the old speed: 128 bytes, 22 ms at 57600 baud at most. */
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
    WRITE_PERI_REG(UART_INT_ENA(0), UART_RXFIFO_FULL_INT_ENA | UART_RXFIFO_TOUT_INT_ENA
                   | UART_RXFIFO_OVF_INT_ENA);
    ETS_UART_INTR_ATTACH(on_uart, NULL);
    ETS_UART_INTR_ENABLE();
}

/* --- the radio */

enum { FRAME = 1514 };
/* Frames being sent lie in the SDK's heap, as do its own needs: below this no more are given. */
enum { HEAP_LEFT = 8 * 1024 };

static uint8_t role = STATION_IF;
static uint8_t link_up;
static uint8_t incoming[FRAME];

static struct netif *ICACHE_FLASH_ATTR interface(void)
{
    uint8 mac[6];
    if (!wifi_get_macaddr(role, mac))
        return NULL;
    struct netif *at = netif_list;
    while (at && os_memcmp(at->hwaddr, mac, 6))
        at = at->next;
    return at;
}

static err_t ICACHE_FLASH_ATTR on_frame(struct pbuf *packet, struct netif *from)
{
    (void)from;
    if (packet->tot_len <= FRAME) {
        uint32_t len = pbuf_copy_partial(packet, incoming, packet->tot_len, 0);
        vizflyt_frame_in(incoming, len);
    }
    pbuf_free(packet);
    platform_wake();
    return ERR_OK;
}

/* The SDK makes its interfaces anew as it changes roles and joins: looked at before each poll. */
static void ICACHE_FLASH_ATTR hook(void)
{
    struct netif *ours = interface();
    if (ours && ours->input != on_frame)
        ours->input = on_frame;
}

void ICACHE_FLASH_ATTR platform_mac(uint8_t into[6])
{
    wifi_get_macaddr(role, into);
}

uint32_t ICACHE_FLASH_ATTR platform_frame_ready(void)
{
    return link_up && system_get_free_heap_size() > HEAP_LEFT;
}

void ICACHE_FLASH_ATTR platform_frame_out(const uint8_t *frame, uint32_t len)
{
    struct netif *ours = interface();
    if (!ours)
        return;
    /* PBUF_LINK leaves room in front for what the radio puts there. */
    struct pbuf *packet = pbuf_alloc(PBUF_LINK, len, PBUF_RAM);
    if (!packet)
        return; /* as a frame lost on the air; the bridge's sequence counters count it */
    pbuf_take(packet, frame, len);
    ours->linkoutput(ours, packet);
    pbuf_free(packet);
}

/* The SDK's own stack wants an address before it counts an interface as up; nobody talks to it, as
 * it gets no frames: one of the link-local range (RFC 3927) that the bridge itself never takes. */
static void ICACHE_FLASH_ATTR keep_quiet(void)
{
    struct ip_info address;
    IP4_ADDR(&address.ip, 169, 254, 82, 66);
    IP4_ADDR(&address.netmask, 255, 255, 255, 255);
    IP4_ADDR(&address.gw, 0, 0, 0, 0);
    if (role == STATION_IF)
        wifi_station_dhcpc_stop();
    else
        wifi_softap_dhcps_stop();
    wifi_set_ip_info(role, &address);
}

static void ICACHE_FLASH_ATTR on_wifi(System_Event_t *event)
{
    if (role == STATION_IF && event->event == EVENT_STAMODE_CONNECTED)
        link_up = 1;
    else if (role == STATION_IF && event->event == EVENT_STAMODE_DISCONNECTED)
        link_up = 0; /* the SDK goes on trying: its reconnect policy is on */
    else
        return;
    hook();
    happened(VIZFLYT_LINK);
}

static uint32_t ICACHE_FLASH_ATTR fill(uint8 *field, uint32_t size, const char *text)
{
    uint32_t len = os_strlen(text);
    if (len > size)
        len = size;
    os_memset(field, 0, size);
    os_memcpy(field, text, len);
    return len;
}

int32_t ICACHE_FLASH_ATTR platform_wifi_station(const char *ssid, const char *password)
{
    struct station_config config;
    os_memset(&config, 0, sizeof config);
    fill(config.ssid, sizeof config.ssid, ssid);
    fill(config.password, sizeof config.password, password);
    role = STATION_IF;
    link_up = 0;
    /* _current: the SDK keeps a store of its own otherwise; ours is the only one. */
    if (!wifi_set_opmode_current(STATION_MODE) || !wifi_station_set_config_current(&config))
        return -1;
    keep_quiet();
    wifi_station_set_reconnect_policy(1);
    wifi_set_sleep_type(NONE_SLEEP_T); /* sleeping costs 100 ms and more of latency */
    hook();
    happened(VIZFLYT_LINK);
    return wifi_station_connect() ? 0 : -1;
}

int32_t ICACHE_FLASH_ATTR platform_wifi_access_point(const char *ssid, const char *password, uint32_t channel)
{
    struct softap_config config;
    os_memset(&config, 0, sizeof config);
    config.ssid_len = fill(config.ssid, sizeof config.ssid, ssid);
    uint32_t secret = fill(config.password, sizeof config.password, password);
    config.channel = channel;
    config.authmode = secret ? AUTH_WPA2_PSK : AUTH_OPEN;
    config.max_connection = 4;
    config.beacon_interval = 100;
    role = SOFTAP_IF;
    link_up = 0;
    wifi_station_disconnect();
    if (!wifi_set_opmode_current(SOFTAP_MODE) || !wifi_softap_set_config_current(&config))
        return -1;
    keep_quiet();
    wifi_set_sleep_type(NONE_SLEEP_T);
    link_up = 1;
    hook();
    happened(VIZFLYT_LINK);
    return 0;
}

uint32_t platform_link_up(void)
{
    return link_up;
}

int32_t ICACHE_FLASH_ATTR platform_rssi_dbm(void)
{
    if (role != STATION_IF || !link_up)
        return 0;
    sint8 dbm = wifi_station_get_rssi();
    return dbm < 0 ? dbm : 0; /* 31: it failed */
}

/* --- the LED of an ESP-12F, between GPIO2 and 3.3 V */

void ICACHE_FLASH_ATTR platform_led(uint32_t on)
{
    GPIO_OUTPUT_SET(GPIO_ID_PIN(2), on ? 0 : 1);
}

/* --- the flash: the SDK wants whole words from aligned memory */

static uint32_t words[64];

int32_t ICACHE_FLASH_ATTR platform_flash_read(uint32_t address, uint8_t *into, uint32_t len)
{
    while (len) {
        uint32_t part = len < sizeof words ? len : sizeof words;
        if (spi_flash_read(address, (uint32 *)words, part) != SPI_FLASH_RESULT_OK)
            return -1;
        os_memcpy(into, words, part);
        address += part;
        into += part;
        len -= part;
    }
    return 0;
}

int32_t ICACHE_FLASH_ATTR platform_flash_write(uint32_t address, const uint8_t *bytes, uint32_t len)
{
    while (len) {
        uint32_t part = len < sizeof words ? len : sizeof words;
        os_memcpy(words, bytes, part);
        if (spi_flash_write(address, (uint32 *)words, part) != SPI_FLASH_RESULT_OK)
            return -1;
        address += part;
        bytes += part;
        len -= part;
    }
    return 0;
}

int32_t ICACHE_FLASH_ATTR platform_flash_erase(uint32_t sector)
{
    return spi_flash_erase_sector(sector) == SPI_FLASH_RESULT_OK ? 0 : -1;
}

/* --- the beginning */

static void ICACHE_FLASH_ATTR started(void)
{
    running = 1;
    vizflyt_start();
    platform_wake();
}

static void ICACHE_FLASH_ATTR silence(char unused)
{
    (void)unused;
}

void ICACHE_FLASH_ATTR user_init(void)
{
    system_timer_reinit(); /* timers in microseconds, see ets_timer_arm_new; before any is set */
    /* Nothing but MAVLink on the autopilot's line. */
    os_install_putc1((void *)silence);
    system_set_os_print(0);
    system_update_cpu_freq(SYS_CPU_160MHZ);
    gpio_init();
    PIN_FUNC_SELECT(PERIPHS_IO_MUX_GPIO2_U, FUNC_GPIO2);
    platform_led(0);
    wifi_station_set_auto_connect(0);
    wifi_set_event_handler_cb(on_wifi);
    os_timer_disarm(&alarm);
    os_timer_setfn(&alarm, on_alarm, NULL);
    system_os_task(run, TASK, queue, QUEUE);
    system_init_done_cb(started);
}
