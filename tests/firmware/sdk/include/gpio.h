#define GPIO_ID_PIN(n) (n)
#define GPIO_OUTPUT_SET(pin, value) gpio_output_set((value) << (pin), (uint32_t)!(value) << (pin), 1 << (pin), 0)
void gpio_init(void);
void gpio_output_set(uint32 set, uint32 clear, uint32 enable, uint32 disable);
