//! Images as OpenCV matrices over the same shared memory. Needs the feature `opencv`.

use opencv::Result;
use opencv::boxed_ref::BoxedRef;
use opencv::core::{Mat, Vec3b};

use crate::observation::CameraImage;

impl<'a> CameraImage<'a> {
    /// Returns the colour image as a matrix over the same memory, H x W of `CV_8UC3`. The channel order is red, green,
    /// blue: use `COLOR_RGB2GRAY` and similar, not `COLOR_BGR2...`.
    ///
    /// # Errors
    /// Errors of OpenCV; none is expected for a valid image.
    pub fn rgb_mat(&self) -> Result<BoxedRef<'a, Mat>> {
        Mat::new_rows_cols_with_bytes::<Vec3b>(self.rows(), self.cols(), self.rgb)
    }

    /// Returns the depth image as a matrix over the same memory, H x W of `CV_16UC1`. 0 means no return. [mm, cam]
    ///
    /// # Errors
    /// As [`Self::rgb_mat`].
    pub fn depth_mm_mat(&self) -> Result<BoxedRef<'a, Mat>> {
        Mat::new_rows_cols_with_data(self.rows(), self.cols(), self.depth_mm)
    }

    fn rows(&self) -> i32 {
        self.height_px as i32
    }

    fn cols(&self) -> i32 {
        self.width_px as i32
    }
}

#[cfg(test)]
mod tests {
    use opencv::imgproc::{COLOR_RGB2GRAY, cvt_color_def};
    use opencv::prelude::*;
    use vizflyt_protocol::geometry::Intrinsics;

    use crate::{CameraInfo, ImageStamps, ObservationBuffer};

    #[test]
    fn matrices_share_the_memory_of_the_image() {
        let front = CameraInfo::forward("front", Intrinsics::from_horizontal_fov(7, 5, 1.5));
        let mut buffer = ObservationBuffer::new(&[front]);
        buffer.set_image(0, ImageStamps::default(), |planes| {
            planes.rgb.fill(0);
            // Column 2 of row 1 is pure red at 4.321 m.
            planes.rgb[3 * 9] = 255;
            planes.depth_mm[9] = 4321;
        });
        let observation = buffer.observation();
        let image = observation.camera("front").unwrap();
        let (rgb, depth) = (image.rgb_mat().unwrap(), image.depth_mm_mat().unwrap());
        assert_eq!(rgb.data(), image.rgb.as_ptr());
        assert_eq!(depth.data(), image.depth_mm.as_ptr().cast());
        assert_eq!((rgb.rows(), rgb.cols()), (5, 7));
        assert_eq!(*depth.at_2d::<u16>(1, 2).unwrap(), 4321);
        let mut gray = Mat::default();
        cvt_color_def(&rgb, &mut gray, COLOR_RGB2GRAY).unwrap();
        // The weight of red is 0.299 in BT.601.
        assert_eq!(*gray.at_2d::<u8>(1, 2).unwrap(), 76);
        assert_eq!(*gray.at_2d::<u8>(2, 1).unwrap(), 0);
    }
}
