#include "ets_sys.h"
