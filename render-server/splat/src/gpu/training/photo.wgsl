// What all passes of training know of the photo that is rendered.

/// The camera of a photo and the style of its rendering. `photo.rs` holds the same in Rust.
struct Photo {
    /// Row of the rotation to the camera's axes; the camera's centre, x.
    row_x: vec4<f32>,
    /// ... y.
    row_y: vec4<f32>,
    /// ... z.
    row_z: vec4<f32>,
    /// fx fy cx cy. [px]
    focal: vec4<f32>,
    /// Slopes between which a splat is linearised: least x, y, greatest x, y.
    slopes: vec4<f32>,
    /// Width, height [px], tiles across, tiles.
    size: vec4<u32>,
    /// Rows, numbers of each, degree of the harmonics that count, 1 if anti-aliased.
    rows: vec4<u32>,
    /// Near plane; nothing.
    near: vec4<f32>,
}

@group(0) @binding(0) var<uniform> photo: Photo;
