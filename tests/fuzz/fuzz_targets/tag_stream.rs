//! Images on a pipe (YUV4MPEG2): the same images for chunks of any size.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_tags::capture::Y4m;

fuzz_target!(|input: (u8, &[u8])| {
    let (chunk, bytes) = input;
    let whole = images(bytes, bytes.len().max(1));
    assert_eq!(images(bytes, usize::from(chunk).max(1)), whole);
});

fn images(bytes: &[u8], chunk: usize) -> Vec<(Option<u64>, usize)> {
    let mut stream = Y4m::default();
    let mut found = Vec::new();
    for bytes in bytes.chunks(chunk) {
        stream.push(bytes);
        loop {
            match stream.poll() {
                Ok(Some((stamp_ns, image))) => found.push((stamp_ns, image.pixels().len())),
                Ok(None) => break,
                Err(why) => {
                    assert!(!why.is_empty());
                    return found;
                }
            }
        }
    }
    found
}
