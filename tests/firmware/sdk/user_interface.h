#include <stdbool.h>
#include "os_type.h"
#include "lwip/ip_addr.h"
enum { USER_TASK_PRIO_1 = 1, SYS_CPU_160MHZ = 160 };
enum { STATION_MODE = 1, SOFTAP_MODE = 2, STATION_IF = 0, SOFTAP_IF = 1 };
enum { EVENT_STAMODE_CONNECTED, EVENT_STAMODE_DISCONNECTED };
enum { SYSTEM_PARTITION_RF_CAL = 4, SYSTEM_PARTITION_PHY_DATA, SYSTEM_PARTITION_SYSTEM_PARAMETER, SYSTEM_PARTITION_CUSTOMER_BEGIN = 100 };
enum flash_size_map { FLASH_SIZE_32M_MAP_512_512 = 4 };
enum sleep_type { NONE_SLEEP_T };
typedef enum { AUTH_OPEN, AUTH_WEP, AUTH_WPA_PSK, AUTH_WPA2_PSK } AUTH_MODE;
typedef struct { int type; uint32_t addr, size; } partition_item_t;
typedef struct { uint32 event; } System_Event_t;
struct station_config { uint8 ssid[32], password[64], bssid_set, bssid[6]; };
struct softap_config { uint8 ssid[32], password[64], ssid_len, channel; AUTH_MODE authmode; uint8 ssid_hidden, max_connection; uint16 beacon_interval; };
bool system_partition_table_regist(const partition_item_t *table, uint32_t count, uint32_t map);
bool system_os_task(void (*task)(os_event_t *), uint8 priority, os_event_t *queue, uint8 length);
bool system_os_post(uint8 priority, uint32_t signal, uint32_t parameter);
uint32 system_get_time(void);
uint32 system_get_free_heap_size(void);
void system_restart(void);
void system_soft_wdt_feed(void);
void system_timer_reinit(void);
void system_set_os_print(uint8 on);
bool system_update_cpu_freq(uint8 megahertz);
void system_init_done_cb(void (*done)(void));
bool wifi_get_macaddr(uint8 interface, uint8 *address);
bool wifi_set_opmode_current(uint8 mode);
bool wifi_station_set_config_current(struct station_config *config);
bool wifi_softap_set_config_current(struct softap_config *config);
bool wifi_station_connect(void);
bool wifi_station_disconnect(void);
bool wifi_station_dhcpc_stop(void);
bool wifi_softap_dhcps_stop(void);
bool wifi_station_set_auto_connect(uint8 on);
bool wifi_station_set_reconnect_policy(bool on);
bool wifi_set_sleep_type(enum sleep_type type);
bool wifi_set_ip_info(uint8 interface, struct ip_info *info);
sint8 wifi_station_get_rssi(void);
void wifi_set_event_handler_cb(void (*handler)(System_Event_t *));
