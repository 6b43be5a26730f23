/* Platform of the bridge on the chip, based on the vendor's NONOS SDK.
 *
 * The SDK contains the radio, association, encryption, and an lwIP that is not used: each of its interfaces
 * passes received frames to `netif->input`, which is set to `on_frame`, and sends frames given to
 * `netif->linkoutput`. Everything runs in the SDK's only thread: its timers, its radio callbacks, and one
 * user task that polls the bridge. Nothing here blocks, because the SDK's watchdog and radio need the thread
 * within milliseconds.
 *
 * Written for the headers of SDK 3.0.5 (include/, third_party/include/, driver_lib/). Functions without
 * ICACHE_FLASH_ATTR lie in the instruction RAM, because interrupts use them.
 *
 * The core's constants lie in flash. Reading a byte from there is an exception that the SDK handles;
 * meanwhile the ROM allows interrupts, even if they were disabled. Therefore, interrupts here use no data of
 * the core, and data shared with interrupts is changed without reading flash. */

#include "sdk.h"

/* --- flash, 4 MB: program at 0 and 0x10000 (eagle.app.v6.ld), data of the SDK at the end */

enum {
    SETTINGS = 0x3F0000, /* used by the core; see ../src/lib.rs */
    RF_CALIBRATION = 0x3FB000,
    PHY_DATA = 0x3FC000,       /* esp_init_data_default_v08.bin of the SDK */
    SYSTEM_PARAMETERS = 0x3FD000,
};

/* The SDK reads the partitions before anything else. */
static const partition_item_t partitions[] ICACHE_RODATA_ATTR = {
    {SYSTEM_PARTITION_CUSTOMER_BEGIN + 1, 0x00000, 0x10000},
    {SYSTEM_PARTITION_CUSTOMER_BEGIN + 2, 0x10000, 0x5C000},
    {SYSTEM_PARTITION_CUSTOMER_BEGIN + 3, SETTINGS, 0x2000},
    {SYSTEM_PARTITION_RF_CAL, RF_CALIBRATION, 0x1000},
    {SYSTEM_PARTITION_PHY_DATA, PHY_DATA, 0x1000},
    {SYSTEM_PARTITION_SYSTEM_PARAMETER, SYSTEM_PARAMETERS, 0x3000},
};

void ICACHE_FLASH_ATTR user_pre_init(void)
{
    /* Without partitions nothing can run; the watchdog restarts the chip. */
    while (!system_partition_table_regist(partitions, sizeof partitions / sizeof partitions[0],
                                          FLASH_SIZE_32M_MAP_512_512)) {
    }
}

/* --- the loop */

enum { TASK = USER_TASK_PRIO_1, QUEUE = 4 };

static os_event_t queue[QUEUE];
static ETSTimer alarm;
static volatile uint32_t pending; /* events, from interrupts and callbacks */
static volatile uint8_t posted;   /* a poll is already requested */
static uint8_t running;           /* vizflyt_start has returned */

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
        posted = 0; /* the queue is full: a poll will come anyway */
}

void happened(uint32_t events)
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
    radio_hook();
    uint32_t due_us = vizflyt_poll(events | VIZFLYT_FRAMES);
    os_timer_disarm(&alarm);
    if (due_us != UINT32_MAX) {
        /* The SDK's timer accepts 0.1 ms to 134 s. */
        if (due_us < 100)
            due_us = 100;
        if (due_us > 100000000)
            due_us = 100000000;
        os_timer_arm_us(&alarm, due_us, 0);
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
        /* The restart happens when this task returns to the SDK, or by the watchdog. */
        system_soft_wdt_feed();
    }
}

/* Fatal error of the core. Why only a restart: no serial port is free for a message, because one belongs to
 * the autopilot and the pin of the other to the LED. The bridge is back within a second; the autopilot's own
 * failsafe takes longer. */
void ICACHE_FLASH_ATTR abort(void)
{
    platform_restart();
}

/* --- the LED of an ESP-12F, between GPIO2 and 3.3 V */

void ICACHE_FLASH_ATTR platform_led(uint32_t on)
{
    GPIO_OUTPUT_SET(GPIO_ID_PIN(2), on ? 0 : 1);
}

/* --- flash: the SDK requires whole words in aligned memory */

int32_t ICACHE_FLASH_ATTR platform_flash_read(uint32_t address, uint8_t *into, uint32_t len)
{
    uint32_t words[FLASH_AT_ONCE / 4];
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
    uint32_t words[FLASH_AT_ONCE / 4];
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

/* --- start */

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
    system_timer_reinit(); /* enables timers in microseconds; must precede all timers */
    /* Only MAVLink on the autopilot's line. */
    os_install_putc1(silence);
    system_set_os_print(0);
    system_update_cpu_freq(SYS_CPU_160MHZ);
    gpio_init();
    PIN_FUNC_SELECT(PERIPHS_IO_MUX_GPIO2_U, FUNC_GPIO2);
    platform_led(0);
    radio_begin();
    os_timer_disarm(&alarm);
    os_timer_setfn(&alarm, on_alarm, NULL);
    system_os_task(run, TASK, queue, QUEUE);
    system_init_done_cb(started);
}
