//! arena.toml: an error, or an arena that the types of runtime and server accept.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_arena::config::line_of;
use vizflyt_arena::{ArenaConfig, MovingObjects};
use vizflyt_protocol::geometry::Pose;
use vizflyt_server::poses::settings;

fuzz_target!(|text: &str| {
    if let Ok(arena) = ArenaConfig::parse(text) {
        assert!(arena.geofence().is_valid());
        for camera in &arena.info().cameras {
            assert!(camera.intrinsics.validate().is_ok());
        }
        let again = ArenaConfig::parse(&arena.to_toml().unwrap()).unwrap();
        assert_eq!(again.to_toml().unwrap(), arena.to_toml().unwrap());
        for since_epoch_ns in [i64::MIN, -1, 0, 1_234_567_890, i64::MAX] {
            let placements = MovingObjects::new(&arena, 7).placements(since_epoch_ns);
            assert!(placements.iter().flatten().all(Pose::is_valid));
        }
    }
    // Tables that only the server reads.
    if let Ok(sources) = settings::read_all(text) {
        assert!(sources.len() <= settings::MAX_SOURCES);
    }
    // Key lookup must also work in texts that are not an arena.
    for key in ["stages[0].name", "objects[1].motion.axis", "[[", "name.name"] {
        assert!(line_of(text, key).is_none_or(|line| line <= text.matches('\n').count() + 1));
    }
});
