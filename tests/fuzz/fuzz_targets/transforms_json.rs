//! Untrusted transforms.json and PLY point cloud.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_twin::dataset::{nerfstudio, point_cloud};

fuzz_target!(|bytes: &[u8]| {
    if let Ok(text) = std::str::from_utf8(bytes) {
        match nerfstudio::parse(text) {
            Ok(transforms) => {
                for frame in &transforms.frames {
                    assert!(frame.world_from_cam.translation_m.is_finite());
                    assert!(
                        frame.intrinsics.is_err() || frame.intrinsics.unwrap().validate().is_ok()
                    );
                }
            }
            Err(error) => assert!(!error.to_string().is_empty()),
        }
    }
    match point_cloud::parse(bytes) {
        Ok(points) => {
            assert!(points.len() <= bytes.len());
            assert!(points.iter().all(|(position, _)| position.is_finite()));
        }
        Err(error) => assert!(!error.is_empty()),
    }
});
