//! Localization for the lab without motion capture: printed AprilTags and one to four cameras.
//!
//! Two setups from the same mathematics: *outside-in*, fixed cameras that look at a cube of tags on
//! the vehicle; *inside-out*, a camera on the vehicle that looks at a surveyed mat of tags.
//!
//! Read in this order:
//! - [`family`]: which tags there are, and the cells of each;
//! - [`layout`]: where tags are, on a mat in the room or on a cube on the vehicle; a TOML file;
//! - [`camera`]: a camera's lens and where it is; a TOML file;
//! - [`detection`]: a tag seen in an image: what detection yields and everything else consumes;
//! - [`image`]: a grey image; [`detect`] finds tags in it;
//! - [`solve`]: the vehicle's pose from all tags in all cameras;
//! - [`locate`]: images in, the vehicle's pose out;
//! - [`print`]: tags on paper; [`capture`]: images from cameras, folders, videos;
//! - [`checkerboard`]: a checkerboard in an image; [`calibrate`]: a camera's lens; [`survey`]: where tags and cameras really are;
//! - [`synth`]: renders what a camera sees of tags, with known truth; [`simulated`]: the webcams of the
//!   simulated lab.

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
