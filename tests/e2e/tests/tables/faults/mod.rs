//! Faults of the network, on a virtual clock: minutes of traffic in seconds.
//!
//! The real transport of server and runtime, between a source of images without a renderer and a
//! sink without a decoder, over a network in memory with seeded impairment. What each fault does is
//! a table, `table.txt` beside this file; `VIZFLYT_FAULTS=write cargo test -p vizflyt-e2e
//! --test tables faults` writes it anew.

mod memory;
mod network;
mod rig;
mod table;
mod world;

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use table::{Case, Row, Script};
use vizflyt_server::stream::transport::Congestion;

/// Plays all cases, on all cores.
fn play(cases: &[Case]) -> Vec<Row> {
    let next = AtomicUsize::new(0);
    let rows = Mutex::new(Vec::new());
    std::thread::scope(|scope| {
        for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(|| {
                while let index = next.fetch_add(1, Ordering::Relaxed)
                    && let Some(case) = cases.get(index)
                {
                    let row = case.play();
                    world::lock(&rows).push((index, row));
                }
            });
        }
    });
    let mut rows = rows.into_inner().unwrap();
    rows.sort_by_key(|(index, _)| *index);
    rows.into_iter().map(|(_, row)| row).collect()
}

#[test]
fn the_table_of_faults() {
    let cases = table::cases();
    let rows = play(&cases);
    let found = table::text(&rows);
    println!("{found}");
    for (case, row) in cases.iter().zip(&rows) {
        let name = &row.name;
        assert_eq!((row.lost, row.doubled), (0, 0), "{name}: events");
        assert!(row.events > 40, "{name}: events are sent");
        assert_eq!(row.backwards, 0, "{name}: images go backwards");
        if case.congestion == Congestion::Auto {
            assert!(row.delivered >= 50.0, "{name}: what nobody chose delivers:\n{found}");
        }
        if case.path.loss == 0.05 && case.congestion == Congestion::Lan {
            assert!(row.delivered >= 99.0 && row.age_ms[1] <= 30.0, "{name}:\n{found}");
        }
        if case.script == Script::Blackout && name.ends_with("lan") {
            assert!(row.newest_ms.is_some_and(|ms| ms <= 60.0), "{name}:\n{found}");
        }
    }
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/tables/faults/table.txt");
    if std::env::var("VIZFLYT_FAULTS").is_ok_and(|what| what == "write") {
        std::fs::write(path, &found).unwrap();
    }
    let committed = std::fs::read_to_string(path).unwrap();
    let differences = table::differences(&found, &committed);
    assert!(differences.is_empty(), "{}", differences.join("\n"));
}

/// Ten minutes at 100 Hz: tables of bounded size fill in the first minutes, then nothing grows.
#[test]
fn a_soak_leaves_memory_flat() {
    let bytes = table::soak(Duration::from_mins(2), 5);
    println!("live bytes every two minutes: {bytes:?}");
    assert!(bytes[4] <= bytes[0] + BOUNDED_TABLES, "{bytes:?}");
    assert!(bytes[4] <= bytes[2] + UNDER_WAY, "{bytes:?}");
}

/// Samples of the clock filter, the rings of the stages' times, the log of events, whose entries hold why a flight
/// ended: it doubles to its most, some 340 KB, in the first four minutes. [bytes]
const BOUNDED_TABLES: usize = 384 << 10;
/// Packets on their way differ from moment to moment; a byte per image would be 24 KB. [bytes]
const UNDER_WAY: usize = 16 << 10;
