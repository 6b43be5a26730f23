//! The runtime (in construction).
#![allow(missing_docs)]
pub mod guard;
