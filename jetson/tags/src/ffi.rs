//! Calls of the AprilTag C library that describe its tag families.

#![allow(unsafe_code, reason = "calls the AprilTag C library")]

use apriltag_sys as sys;

use crate::family::{Cells, TagFamily};

/// A family of the C library, freed when dropped.
struct Family {
    family: TagFamily,
    raw: *mut sys::apriltag_family_t,
}

impl Family {
    fn new(family: TagFamily) -> Self {
        // SAFETY: these functions have no arguments and return a newly allocated family.
        let raw = unsafe {
            match family {
                TagFamily::Tag36h11 => sys::tag36h11_create(),
                TagFamily::Tag25h9 => sys::tag25h9_create(),
                TagFamily::Tag16h5 => sys::tag16h5_create(),
                TagFamily::TagStandard41h12 => sys::tagStandard41h12_create(),
                TagFamily::TagStandard52h13 => sys::tagStandard52h13_create(),
            }
        };
        assert!(!raw.is_null(), "out of memory");
        Self { family, raw }
    }

    fn get(&self) -> &sys::apriltag_family_t {
        // SAFETY: `raw` came from `*_create`, is not null, and lives as long as `self`.
        unsafe { &*self.raw }
    }
}

impl Drop for Family {
    fn drop(&mut self) {
        // SAFETY: each call destroys the family that its `*_create` made in `new`, exactly once.
        unsafe {
            match self.family {
                TagFamily::Tag36h11 => sys::tag36h11_destroy(self.raw),
                TagFamily::Tag25h9 => sys::tag25h9_destroy(self.raw),
                TagFamily::Tag16h5 => sys::tag16h5_destroy(self.raw),
                TagFamily::TagStandard41h12 => sys::tagStandard41h12_destroy(self.raw),
                TagFamily::TagStandard52h13 => sys::tagStandard52h13_destroy(self.raw),
            }
        }
    }
}

/// Returns the number of tags in a family.
pub(crate) fn ids(family: TagFamily) -> u32 {
    Family::new(family).get().ncodes
}

/// Returns the cells of a tag; `None` if the family does not have this id.
pub(crate) fn cells(family: TagFamily, id: u32) -> Option<Cells> {
    let family = Family::new(family);
    let get = family.get();
    if id >= get.ncodes {
        return None;
    }
    let (across, border) = (get.total_width as u32, get.width_at_border as u32);
    // SAFETY: the family is alive, and `id` is less than `ncodes`, as the function requires.
    let image = unsafe { sys::apriltag_to_image(family.raw, id) };
    assert!(!image.is_null(), "out of memory");
    let mut white = Vec::with_capacity((across * across) as usize);
    for row in 0..across {
        for column in 0..across {
            // SAFETY: the image is `total_width` wide and high, each row `stride` bytes apart.
            let cell = unsafe {
                let at = row as usize * (*image).stride as usize + column as usize;
                *(*image).buf.add(at)
            };
            white.push(cell != 0);
        }
    }
    // SAFETY: the library made the image above; it is destroyed once.
    unsafe { sys::image_u8_destroy(image) };
    Some(Cells::new(across, border, white))
}
