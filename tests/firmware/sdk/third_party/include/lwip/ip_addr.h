#ifndef SDK_IP_ADDR_H
#define SDK_IP_ADDR_H
typedef struct ip_addr { uint32_t addr; } ip_addr_t;
struct ip_info { struct ip_addr ip, netmask, gw; };
#define IP4_ADDR(to, a, b, c, d) (to)->addr = (uint32_t)(d) << 24 | (uint32_t)(c) << 16 | (uint32_t)(b) << 8 | (a)
#endif
