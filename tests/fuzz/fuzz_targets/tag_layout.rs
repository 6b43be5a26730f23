//! Tag layout or checkerboard: an error message, or data that is unchanged after writing and reading.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_tags::checkerboard::Checkerboard;
use vizflyt_tags::layout::TagLayout;

fuzz_target!(|text: &str| {
    match TagLayout::parse(text) {
        Ok(layout) => {
            for tag in &layout.tags {
                assert!(tag.corners_m().iter().all(|corner| corner.is_finite()));
            }
            assert_eq!(TagLayout::parse(&layout.to_toml().unwrap()).unwrap(), layout);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
    match Checkerboard::parse(text) {
        Ok(board) => {
            assert!(board.corners_m().iter().all(|corner| corner.is_finite()));
            assert_eq!(Checkerboard::parse(&board.to_toml().unwrap()).unwrap(), board);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
});
