//! A synthetic hall: what is exact is found exactly, and bounds hold for what is not.
