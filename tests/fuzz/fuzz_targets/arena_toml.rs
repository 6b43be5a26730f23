//! An arena.toml: an error or an arena that the runtime's and the server's types accept.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_arena::ArenaConfig;

fuzz_target!(|text: &str| {
    if let Ok(arena) = ArenaConfig::parse(text) {
        assert!(arena.geofence().is_valid());
        for camera in &arena.info().cameras {
            assert!(camera.intrinsics.validate().is_ok());
        }
        let again = ArenaConfig::parse(&arena.to_toml().unwrap()).unwrap();
        assert_eq!(again, arena);
    }
});
