//! The two tables that are measured on a virtual clock: what each loss of a link costs, and what a bad network does.

mod failsafe;
mod faults;
