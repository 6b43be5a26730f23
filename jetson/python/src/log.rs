//! Decoder for the images of a flight log. `python/vizflyt/_log.py` reads the file itself.

use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArray2, PyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use vizflyt_rgbd::{DecodeError, Decoder, join_jpeg, peek};

/// Colour and depth of a decoded image.
type Arrays<'py> = (Bound<'py, PyArray3<u8>>, Bound<'py, PyArray2<u16>>);

/// Not for plugins: returns colour (H, W, 3) and depth (H, W) [mm] of an image in a log. `jpeg` is the colour if
/// the log stores it separately.
///
/// Raises ValueError if the image does not decode.
#[pyfunction]
#[pyo3(signature = (bitstream, jpeg = None))]
pub(crate) fn decode_image<'py>(
    py: Python<'py>,
    bitstream: &[u8],
    jpeg: Option<&[u8]>,
) -> PyResult<Arrays<'py>> {
    let decoded = py.detach(|| decode(bitstream, jpeg));
    let (rgb, depth_mm) = decoded
        .map_err(|error| PyValueError::new_err(format!("an image does not decode: {error}")))?;
    Ok((rgb.into_pyarray(py), depth_mm.into_pyarray(py)))
}

fn decode(bitstream: &[u8], jpeg: Option<&[u8]>) -> Result<(Array3<u8>, Array2<u16>), DecodeError> {
    let mut whole = Vec::new();
    if let Some(jpeg) = jpeg {
        join_jpeg(jpeg, bitstream, &mut whole)?;
    } else {
        whole.extend_from_slice(bitstream);
    }
    let info = peek(&whole)?;
    let (width, height) = (info.width as usize, info.height as usize);
    let mut rgb = Array3::zeros((height, width, 3));
    let mut depth_mm = Array2::zeros((height, width));
    let rows = "new arrays are contiguous";
    Decoder::new().decode(
        &whole,
        rgb.as_slice_mut().expect(rows),
        depth_mm.as_slice_mut().expect(rows),
    )?;
    Ok((rgb, depth_mm))
}
