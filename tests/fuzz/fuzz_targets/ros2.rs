//! Messages of a ROS 2 domain, in either byte order: no panic, no more data than their bytes hold, and only commands
//! that the guard accepts.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_ros2::cdr::Reader;
use vizflyt_ros2::convert::Frames;
use vizflyt_ros2::messages::{Path, PoseStamped, Received, TwistStamped};
use vizflyt_ros2::setpoint::Commands;

fuzz_target!(|input: (bool, &[u8])| {
    let (little, bytes) = input;
    let (frames, mut commands) = (Frames::new(""), Commands::default());
    let _ = PoseStamped::read(&mut Reader::new(bytes, little));
    if let Ok(twist) = TwistStamped::read(&mut Reader::new(bytes, little))
        && commands.velocity(&frames, &twist, 0, 0).is_ok()
    {
        assert!(commands.setpoint(0).check().is_ok());
    }
    if let Ok(path) = Path::read(&mut Reader::new(bytes, little)) {
        assert!(path.poses.len() * 64 <= bytes.len());
        if commands.path(&frames, &path, 1.0).is_ok() {
            assert!(commands.setpoint(0).check().is_ok());
        }
    }
});
