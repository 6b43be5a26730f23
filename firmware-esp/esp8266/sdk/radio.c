/* The radio at layer 2: the SDK's lwIP exists, but receives no frames. */

#include "sdk.h"

static uint8_t role = STATION_IF;
static uint8_t link_up;
static struct pbuf *waiting[FRAMES_WAITING];
static uint8_t waiting_first, waiting_count;

static err_t ICACHE_FLASH_ATTR on_frame(struct pbuf *packet, struct netif *from)
{
    (void)from;
    /* Received frames are one piece; a chain would be merged. */
    if (packet->next)
        packet = pbuf_coalesce(packet, PBUF_RAW);
    if (waiting_count == FRAMES_WAITING || packet->next || packet->tot_len > FRAME) {
        /* Like a loss on the air: the sequence numbers of the packets show it. */
        pbuf_free(packet);
    } else {
        waiting[(waiting_first + waiting_count++) % FRAMES_WAITING] = packet;
    }
    happened(VIZFLYT_FRAMES);
    return ERR_OK;
}

uint8_t *ICACHE_FLASH_ATTR platform_frame_waiting(uint32_t *len)
{
    if (!waiting_count)
        return NULL;
    *len = waiting[waiting_first]->len;
    return waiting[waiting_first]->payload;
}

void ICACHE_FLASH_ATTR platform_frame_done(void)
{
    pbuf_free(waiting[waiting_first]);
    waiting_first = (waiting_first + 1) % FRAMES_WAITING;
    waiting_count--;
}

/* The SDK recreates its interfaces when it changes role or joins, so this is called before each poll. */
void ICACHE_FLASH_ATTR radio_hook(void)
{
    struct netif *ours = eagle_lwip_getif(role);
    if (ours && ours->input != on_frame)
        ours->input = on_frame;
}

void ICACHE_FLASH_ATTR platform_mac(uint8_t into[6])
{
    wifi_get_macaddr(role, into);
}

static struct pbuf *sending;

uint8_t *ICACHE_FLASH_ATTR platform_frame_begin(void)
{
    if (!link_up || system_get_free_heap_size() < HEAP_LEFT)
        return NULL;
    /* PBUF_LINK reserves space for the radio's header. */
    sending = pbuf_alloc(PBUF_LINK, FRAME, PBUF_RAM);
    return sending ? sending->payload : NULL;
}

void ICACHE_FLASH_ATTR platform_frame_send(uint32_t len)
{
    struct netif *ours = eagle_lwip_getif(role);
    sending->len = sending->tot_len = len;
    if (len < FRAME / 2) {
        /* The frame may wait in the radio's queue: give a small one a smaller buffer, if memory is available. */
        struct pbuf *fitting = pbuf_alloc(PBUF_LINK, len, PBUF_RAM);
        if (fitting) {
            os_memcpy(fitting->payload, sending->payload, len);
            pbuf_free(sending);
            sending = fitting;
        }
    }
    if (ours)
        ours->linkoutput(ours, sending);
    platform_frame_drop(); /* the radio holds its own reference */
}

void ICACHE_FLASH_ATTR platform_frame_drop(void)
{
    pbuf_free(sending);
    sending = NULL;
}

/* The SDK's stack counts an interface as up only with an address. That stack receives no frames, so it gets a
 * link-local address (RFC 3927) that the bridge never uses. */
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
        link_up = 0; /* the SDK retries: its reconnect policy is on */
    else
        return;
    radio_hook();
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
    /* _current: do not save to the SDK's own settings; the bridge has its own. */
    if (!wifi_set_opmode_current(STATION_MODE) || !wifi_station_set_config_current(&config))
        return -1;
    keep_quiet();
    wifi_station_set_reconnect_policy(1);
    wifi_set_sleep_type(NONE_SLEEP_T); /* sleep would add at least 100 ms of latency */
    radio_hook();
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
    radio_hook();
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
    return dbm < 0 ? dbm : 0; /* 31: failed */
}

void ICACHE_FLASH_ATTR radio_begin(void)
{
    wifi_station_set_auto_connect(0);
    wifi_set_event_handler_cb(on_wifi);
}
