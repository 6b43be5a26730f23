#!/usr/bin/env python3
"""Runs the same filter in flight."""

from complementary import Filter
from flight import AttitudeFlight

import vizflyt

if __name__ == "__main__":
    vizflyt.run(AttitudeFlight(Filter))
