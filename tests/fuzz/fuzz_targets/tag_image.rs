//! Image files (PNG, JPEG, PGM) and their stamp files: images of the stated size, or an error message.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_tags::capture::{decode, parse_stamps};
use vizflyt_tags::checkerboard::Checkerboard;

fuzz_target!(|bytes: &[u8]| {
    match decode(bytes) {
        Ok(image) => {
            let count = image.width_px() as usize * image.height_px() as usize;
            assert!(count > 0 && image.pixels().len() == count);
            // Searching a large image takes long and covers no additional code.
            if count < 40_000 {
                let board = Checkerboard { columns: 3, rows: 3, square_m: 0.02 };
                let found = board.find(&image);
                assert!(found.is_none_or(|corners| corners.iter().all(|c| c.is_finite())));
            }
        }
        Err(why) => assert!(!why.is_empty()),
    }
    if let Ok(text) = std::str::from_utf8(bytes)
        && let Err(why) = parse_stamps(text)
    {
        assert!(why.starts_with("line "));
    }
});
