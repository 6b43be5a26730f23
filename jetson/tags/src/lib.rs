//! Localization for the lab without motion capture: printed AprilTags and one to four cameras.
//!
//! Two setups use the same mathematics. *Outside-in*: fixed cameras look at a cube of tags on the vehicle.
//! *Inside-out*: a camera on the vehicle looks at a surveyed mat of tags.
//!
//! Read in this order:
//! - [`family`]: tag families and the cells of each tag
//! - [`layout`]: positions of tags, on a mat in the room or on a cube on the vehicle; a TOML file
//! - [`camera`]: lens and pose of a camera; a TOML file
//! - [`detection`]: a detected tag, the output of detection and the input of all other modules
//! - [`image`]: a grey image; [`detect`] finds tags in it
//! - [`solve`]: the vehicle's pose from all tags in all cameras
//! - [`locate`]: images in, pose of the vehicle out
//! - [`print`]: printable tags; [`capture`]: images from cameras, folders and videos
//! - [`checkerboard`]: detection of a checkerboard; [`calibrate`]: lens calibration; [`survey`]: measured positions of
//!   tags and cameras
//! - [`synth`]: renders images of tags with known ground truth; [`simulated`]: the webcams of the simulated lab

mod bundle;
pub mod calibrate;
pub mod camera;
pub mod capture;
pub mod checkerboard;
pub mod detect;
pub mod detection;
pub mod family;
mod ffi;
pub mod file;
pub mod image;
pub mod layout;
pub mod locate;
pub mod print;
pub mod simulated;
pub mod solve;
pub mod survey;
pub mod synth;
