//! Network faults on a virtual clock: minutes of traffic in seconds.
//!
//! The real transport of server and runtime runs between an image source without renderer and a sink without decoder,
//! over a network in memory with seeded impairment. `table.txt` next to this file lists the effect of each fault;
//! `VIZFLYT_FAULTS=write cargo test -p vizflyt-e2e --test tables faults` rewrites it.

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

/// Runs all cases, on all cores.
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
fn effects_of_network_faults_match_the_table() {
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
            assert!(
                row.delivered >= 50.0,
                "{name}: the default congestion control delivers:\n{found}"
            );
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

/// Ten minutes at 100 Hz: tables of bounded size fill in the first minutes, then the memory must stay constant.
#[test]
fn memory_stays_constant_over_ten_minutes() {
    let bytes = table::soak(Duration::from_mins(2), 5);
    println!("live bytes every two minutes: {bytes:?}");
    assert!(bytes[4] <= bytes[0] + BOUNDED_TABLES, "{bytes:?}");
    assert!(bytes[4] <= bytes[2] + UNDER_WAY, "{bytes:?}");
}

/// Memory of bounded tables: samples of the clock filter, ring buffers of the stages' times, and the event log, whose
/// entries contain the end reason of a flight. The log grows by doubling, to about 340 KB in the first four minutes.
/// [bytes]
const BOUNDED_TABLES: usize = 384 << 10;
/// Variation by packets in transit; a leak of one byte per image would be 24 KB. [bytes]
const UNDER_WAY: usize = 16 << 10;
