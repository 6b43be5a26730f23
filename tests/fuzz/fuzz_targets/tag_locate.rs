//! Images for the tag detector and the localization: any pixels, any regions, any expected tags. Also the file that
//! names cameras and layouts.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_protocol::time::HostTime;
use vizflyt_tags::camera::TagCamera;
use vizflyt_tags::detect::{Detector, DetectorSettings, Region};
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::image::Gray;
use vizflyt_tags::locate::{LocateConfig, LocateSettings, Locator, StampedImage};
use vizflyt_tags::simulated::{cube, webcams};

fuzz_target!(|data: &[u8]| {
    if let Ok(text) = std::str::from_utf8(data) {
        let _ = LocateConfig::parse(text);
    }
    let [width, height, kind, edge, x, y, rest @ ..] = data else { return };
    let (width_px, height_px) = (u32::from(*width), u32::from(*height));
    // Repeat the bytes as pixels, so that small inputs have structure.
    let count = (width_px * height_px) as usize;
    let pixels: Vec<u8> = if rest.is_empty() {
        vec![*kind; count]
    } else {
        rest.iter().copied().cycle().take(count).collect()
    };
    let image = Gray::new(width_px, height_px, pixels).expect("so many were taken");
    let west = webcams(1).remove(0);
    let camera = Intrinsics { width_px, height_px, ..west.intrinsics };
    let families = [TagFamily::ALL[usize::from(*kind) % 4]];
    let mut detector = Detector::new(&families, DetectorSettings::default());
    for tag in detector.search(&image, &camera, kind & 4 != 0) {
        assert!(tag.id < tag.family.ids() && tag.corners_px.iter().all(|c| c.is_finite()));
    }
    let least_px = glam::DVec2::new(f64::from(*x) - 64.0, f64::from(*y) - 64.0);
    let region = Region {
        least_px,
        most_px: least_px + f64::from(*edge),
        tag_edge_px: (*edge > 7).then(|| f64::from(*edge)),
    };
    detector.look(&image, &region, &camera);
    if camera.validate().is_ok() {
        let station = TagCamera { intrinsics: camera, ..west };
        let mut locator = Locator::new(vec![station], &[cube()], LocateSettings::default())
            .expect("the lab is sound");
        for ms in [1, 34, 67] {
            let stamp = HostTime::from_ns(ms * 1_000_000);
            let outcome =
                locator.handle_images(&[StampedImage { camera: 0, stamp, image: &image }]);
            if let Ok(located) = outcome.located {
                assert!(located.world_from_body.is_valid());
                assert!(located.position_sigma_m.is_finite());
            }
        }
    }
});
