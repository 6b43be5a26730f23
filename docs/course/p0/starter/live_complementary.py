#!/usr/bin/env python3
"""The same filter in flight."""

import vizflyt
from complementary import Filter
from flight import AttitudeFlight

if __name__ == "__main__":
    vizflyt.run(AttitudeFlight(Filter))
