#include "lwip/pbuf.h"
struct netif {
    struct netif *next;
    err_t (*input)(struct pbuf *packet, struct netif *from);
    err_t (*linkoutput)(struct netif *to, struct pbuf *packet);
};
