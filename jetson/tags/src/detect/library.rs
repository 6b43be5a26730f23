//! Safe wrapper of the C library: the only module of `detect` with `unsafe`.
//!
//! `apriltag-sys` contains the source of version 3.4.5 and generated bindings. C receives a copy of the image, never
//! the caller's, because with some settings the library blurs its input in place.

#![allow(unsafe_code, reason = "owns objects of the AprilTag C library")]

use std::ptr::NonNull;

use apriltag_sys as c;
use glam::DVec2;

use super::DetectorSettings;
use crate::detection::Detection;
use crate::family::TagFamily;

/// A detector of the C library with its families.
pub(super) struct Library {
    detector: NonNull<c::apriltag_detector_t>,
    families: Vec<Known>,
    /// Buffer that C reads and may write.
    pixels: Vec<u8>,
}

struct Known {
    family: TagFamily,
    table: NonNull<c::apriltag_family_t>,
}

// SAFETY: the detector and its tables are reachable only through this struct, which is not `Sync`. The library keeps no
// thread-local state and, with `nthreads` = 1, starts no threads.
unsafe impl Send for Library {}

impl Library {
    pub(super) fn new(families: &[TagFamily], settings: &DetectorSettings) -> Self {
        // SAFETY: no precondition; the result is checked.
        let detector = NonNull::new(unsafe { c::apriltag_detector_create() })
            .expect("the library returns a detector or the process is out of memory");
        let mut library = Self { detector, families: Vec::new(), pixels: Vec::new() };
        // SAFETY: the detector was just made, and no other pointer to it exists.
        let d = unsafe { &mut *library.detector.as_ptr() };
        d.nthreads = 1;
        d.quad_sigma = 0.0;
        d.refine_edges = true;
        d.decode_sharpening = settings.sharpening;
        d.debug = false;
        for &family in families {
            if library.families.iter().any(|known| known.family == family) {
                continue;
            }
            let table = NonNull::new(create(family))
                .expect("the library returns a family or the process is out of memory");
            library.families.push(Known { family, table });
            // SAFETY: the library made both; the table outlives the detector (see `drop`).
            unsafe {
                c::apriltag_detector_add_family_bits(
                    library.detector.as_ptr(),
                    table.as_ptr(),
                    corrected_bits(family, settings),
                );
            }
        }
        library
    }

    /// Returns the tags in `width` x `height` pixels that `fill` writes, row by row.
    pub(super) fn detect(
        &mut self,
        width: usize,
        height: usize,
        decimate: f32,
        fill: impl FnOnce(&mut Vec<u8>),
    ) -> Vec<Detection> {
        self.pixels.clear();
        fill(&mut self.pixels);
        assert_eq!(self.pixels.len(), width * height, "rows are written without gaps");
        // The library divides the image into tiles of 4 pixels, after decimation.
        if width.min(height) < MIN_SIDE_PX || width.max(height) > MAX_SIDE_PX {
            return Vec::new();
        }
        // SAFETY: no other pointer to the detector exists, see `new`.
        unsafe { (*self.detector.as_ptr()).quad_decimate = decimate };
        let mut image = c::image_u8_t {
            width: width as i32,
            height: height as i32,
            stride: width as i32,
            buf: self.pixels.as_mut_ptr(),
        };
        // SAFETY: `image` describes `pixels` exactly (asserted above). The pixels stay alive and unchanged until the
        // call returns, and the library keeps no pointer to them.
        let list = unsafe { c::apriltag_detector_detect(self.detector.as_ptr(), &raw mut image) };
        let Some(list) = NonNull::new(list) else { return Vec::new() };
        // SAFETY: the library returns a zarray of `size` pointers to detections, valid until they are destroyed below.
        let found = unsafe {
            let list = list.as_ref();
            #[allow(clippy::cast_ptr_alignment)] // Why: read below without alignment.
            let items = list.data.cast::<*const c::apriltag_detection_t>();
            (0..list.size as usize)
                .map(|i| &*items.add(i).read_unaligned())
                .filter_map(|detection| self.read(detection))
                .collect()
        };
        // SAFETY: frees the list and its detections; no pointer to them was kept.
        unsafe { c::apriltag_detections_destroy(list.as_ptr()) };
        found
    }

    fn read(&self, detection: &c::apriltag_detection_t) -> Option<Detection> {
        let known = self.families.iter().find(|k| k.table.as_ptr() == detection.family)?;
        let corners_px = detection.p.map(|[x, y]| DVec2::new(x, y));
        // Degenerate homographies yield corners that are not finite.
        let sane = corners_px.iter().all(|corner| corner.is_finite());
        sane.then(|| Detection {
            family: known.family,
            id: u32::try_from(detection.id).unwrap_or(u32::MAX),
            hamming: u32::try_from(detection.hamming).unwrap_or(u32::MAX),
            margin: f64::from(detection.decision_margin),
            corners_px,
        })
    }
}

impl Drop for Library {
    fn drop(&mut self) {
        // SAFETY: the library made these objects. Each is destroyed once, the detector before the tables that it reads.
        unsafe {
            c::apriltag_detector_destroy(self.detector.as_ptr());
            for known in &self.families {
                destroy(known.family, known.table.as_ptr());
            }
        }
    }
}

/// Returns the number of misread bits to correct.
fn corrected_bits(family: TagFamily, settings: &DetectorSettings) -> i32 {
    match family {
        // The library lists every code with every error: here 2.6 million entries, 120 MB.
        TagFamily::TagStandard52h13 => 0,
        _ => i32::from(settings.corrected_bits.min(MAX_CORRECTED)),
    }
}

fn create(family: TagFamily) -> *mut c::apriltag_family_t {
    // SAFETY: no precondition; each call allocates a table.
    unsafe {
        match family {
            TagFamily::Tag36h11 => c::tag36h11_create(),
            TagFamily::Tag25h9 => c::tag25h9_create(),
            TagFamily::Tag16h5 => c::tag16h5_create(),
            TagFamily::TagStandard41h12 => c::tagStandard41h12_create(),
            TagFamily::TagStandard52h13 => c::tagStandard52h13_create(),
        }
    }
}

/// # Safety
/// `table` came from [`create`] with the same family, and is not used afterwards.
unsafe fn destroy(family: TagFamily, table: *mut c::apriltag_family_t) {
    // SAFETY: guaranteed by the caller.
    unsafe {
        match family {
            TagFamily::Tag36h11 => c::tag36h11_destroy(table),
            TagFamily::Tag25h9 => c::tag25h9_destroy(table),
            TagFamily::Tag16h5 => c::tag16h5_destroy(table),
            TagFamily::TagStandard41h12 => c::tagStandard41h12_destroy(table),
            TagFamily::TagStandard52h13 => c::tagStandard52h13_destroy(table),
        }
    }
}

/// With 3, the list of 36h11 takes 150 MB.
const MAX_CORRECTED: u8 = 2;
/// Smaller images cannot contain a readable tag, and the library's tiles need a minimum size. [px]
const MIN_SIDE_PX: usize = 24;
/// Maximum side of an image in this project. [px]
const MAX_SIDE_PX: usize = 8192;
