//! Tables measured on a virtual clock: failsafe reactions to losses, and effects of network faults.

mod failsafe;
mod faults;
