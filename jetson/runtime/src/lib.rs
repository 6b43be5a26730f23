//! The runtime (in construction).
#![allow(missing_docs)]
pub mod flight;
pub mod guard;
pub mod link;
