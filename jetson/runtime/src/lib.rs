//! The runtime (in construction).
#![allow(missing_docs)]
pub mod flight;
pub mod guard;
pub mod link;
pub mod log;
pub mod report;
pub mod stats;
pub mod supervisor;
