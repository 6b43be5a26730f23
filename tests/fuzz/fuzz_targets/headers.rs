//! Headers of images, observations and sensor readings from a network and from shared memory.
#![no_main]
use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer, ObservationHeader};
use vizflyt_protocol::sensor::ReadingHeader;

fuzz_target!(|bytes: &[u8]| {
    if let Ok((header, _)) = ImageHeader::parse(bytes) {
        assert!(header.intrinsics().validate().is_ok());
        assert!(header.world_from_cam().is_valid());
        assert!(header.most_payload() >= 8 * header.intrinsics().pixels() as u64);
    }
    if let Ok((header, _)) = ReadingHeader::parse(bytes) {
        assert!(header.world_from_body().is_valid() && header.body_from_sensor().is_valid());
        assert!(header.payload_len() <= header.kind().max_records() * header.kind().record_len());
    }
    if let Some(trailer) = bytes.first_chunk::<{ ImageTrailer::SIZE }>()
        && let Ok(found) = ImageTrailer::parse(trailer, bytes.len() as u64)
    {
        assert_eq!(u64::from(found.payload_len.get()), bytes.len() as u64);
    }
    // Shared memory is aligned, unlike the fuzzer's bytes.
    let mut words = vec![0u64; bytes.len().div_ceil(8)];
    let memory = zerocopy::IntoBytes::as_mut_bytes(words.as_mut_slice());
    memory[..bytes.len()].copy_from_slice(bytes);
    if let Ok(header) = ObservationHeader::parse(memory) {
        for camera in &header.cameras[..header.camera_count.into()] {
            let pixels = camera.width_px as usize * camera.height_px as usize;
            assert!(camera.rgb_offset as usize + 3 * pixels <= memory.len());
            assert!(camera.depth_offset as usize + 2 * pixels <= memory.len());
        }
        for sensor in header.sensors(memory) {
            assert!(sensor.seq == 0 || sensor.records(memory).is_some());
        }
    }
});
