#!/usr/bin/env python3
"""Runs the same filter in flight."""

from flight import AttitudeFlight
from ukf import Filter

import vizflyt

if __name__ == "__main__":
    vizflyt.run(AttitudeFlight(Filter))
