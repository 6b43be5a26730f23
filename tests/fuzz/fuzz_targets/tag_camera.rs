//! Camera file: an error message, or a camera that is unchanged after writing and reading.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_tags::camera::TagCamera;

fuzz_target!(|text: &str| match TagCamera::parse(text) {
    Ok(camera) => {
        assert!(camera.intrinsics.validate().is_ok());
        let again = TagCamera::parse(&camera.to_toml().unwrap()).unwrap();
        assert_eq!(again.intrinsics, camera.intrinsics);
        assert_eq!((again.name, again.source), (camera.name, camera.source));
    }
    Err(error) => assert!(!error.to_string().is_empty()),
});
