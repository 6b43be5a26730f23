//! Black-box flights with the real programs in real time. One test program, because each links both halves of the
//! system.

mod bridge;
mod chain;
mod demo;
mod doctor;
mod fly;
mod guardian;
mod lab;
mod linkloss;
mod localization;
mod logs;
mod mat;
mod misbehave;
mod pairing;
mod sensors;
mod signing;
mod stop_button;
mod tags;
