//! Flight logs: any file is read up to its first error; any recorded observation is decoded or rejected.
#![no_main]
use std::collections::HashMap;
use std::io::Cursor;

use libfuzzer_sys::fuzz_target;
use vizflyt_runtime::log::data::FlightData;
use vizflyt_runtime::log::read::{LogReader, Recorded, RecordedFlight};
use vizflyt_runtime::log::{Observation, ObservedImage};
use vizflyt_runtime::replay::{ReplayPlan, decode, observation_len};
use zerocopy::IntoBytes;

/// Maximum size of an observation: larger ones take too long.
const LARGEST: usize = 1 << 22;

fn feed(observation: &Observation) {
    let Some(len) = observation_len(&observation.head).filter(|len| *len <= LARGEST) else {
        return;
    };
    let mut blocks = vec![0u64; len.div_ceil(8)];
    let _ = decode(observation, &mut blocks.as_mut_bytes()[..len], &mut HashMap::new());
}

fuzz_target!(|bytes: &[u8]| {
    if bytes.starts_with(b"VZOB") {
        // Without the container: a head followed by an image's bitstream.
        for image_at in (0..bytes.len()).filter(|at| bytes[*at..].starts_with(b"VZRD")).take(4) {
            let (head, bitstream) = bytes.split_at(image_at);
            let image = ObservedImage { bitstream: bitstream.to_vec(), ..ObservedImage::default() };
            feed(&Observation { head: head.to_vec(), images: vec![image], ..Default::default() });
        }
        return;
    }
    let Ok(reader) = LogReader::new(Cursor::new(bytes)) else { return };
    let _ = ReplayPlan::read(RecordedFlight::new(reader, false));
    let Ok(reader) = LogReader::new(Cursor::new(bytes)) else { return };
    let mut data = FlightData::new(reader, true);
    while let Ok(Some(_)) = data.next() {}
    let Ok(reader) = LogReader::new(Cursor::new(bytes)) else { return };
    let mut flight = RecordedFlight::new(reader, true);
    while let Ok(Some(recorded)) = flight.next() {
        if let Recorded::Observation(observation) = recorded {
            feed(&observation);
        }
    }
});
