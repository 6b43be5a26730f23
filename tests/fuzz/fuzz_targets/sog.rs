//! Untrusted SOG scene: an error or a valid scene. The first byte selects which part of a valid scene the others
//! replace: the complete archive, its metadata, or one of its textures.
#![no_main]
use std::io::{Cursor, Read as _, Write as _};
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use vizflyt_splat::format::{Format, parse};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

/// More splats than the smallest file may hold.
const MAX_SPLATS: usize = 1 << 20;

/// Parts of a valid scene, by name.
static PARTS: LazyLock<Vec<(String, Vec<u8>)>> = LazyLock::new(|| {
    let good = include_bytes!(
        "../../../render-server/splat/tests/data/formats/splat-transform-sog-sh2.sog"
    );
    let mut archive = ZipArchive::new(Cursor::new(&good[..])).expect("a good scene");
    (0..archive.len())
        .map(|i| {
            let mut part = archive.by_index(i).expect("a part");
            let mut bytes = Vec::new();
            part.read_to_end(&mut bytes).expect("its bytes");
            (part.name().expect("its name").into_owned(), bytes)
        })
        .collect()
});

fuzz_target!(|bytes: &[u8]| {
    let Some((&choice, bytes)) = bytes.split_first() else { return };
    let Some(replaced) = usize::from(choice).checked_sub(1) else {
        vizflyt_fuzz::check_scene(parse(bytes, Format::Sog), MAX_SPLATS);
        return;
    };
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    for (i, (name, part)) in PARTS.iter().enumerate() {
        archive.start_file(name, stored).expect("memory");
        let content = if i == replaced % PARTS.len() { bytes } else { part };
        archive.write_all(content).expect("memory");
    }
    let wrapped = archive.finish().expect("memory").into_inner();
    vizflyt_fuzz::check_scene(parse(&wrapped, Format::Sog), MAX_SPLATS);
});
