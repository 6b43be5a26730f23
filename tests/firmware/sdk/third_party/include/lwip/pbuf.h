#ifndef SDK_PBUF_H
#define SDK_PBUF_H
typedef int8_t err_t;
enum { ERR_OK = 0 };
typedef enum { PBUF_TRANSPORT, PBUF_IP, PBUF_LINK, PBUF_RAW } pbuf_layer;
typedef enum { PBUF_RAM, PBUF_ROM, PBUF_REF, PBUF_POOL } pbuf_type;
struct pbuf { struct pbuf *next; void *payload; uint16_t tot_len, len; };
struct pbuf *pbuf_alloc(pbuf_layer layer, uint16_t length, pbuf_type type);
uint8_t pbuf_free(struct pbuf *packet);
struct pbuf *pbuf_coalesce(struct pbuf *packet, pbuf_layer layer);
#endif
