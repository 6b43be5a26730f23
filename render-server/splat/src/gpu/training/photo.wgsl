// Photo that is rendered: shared by all passes of training.

/// Camera of a photo and its rendering options. `GpuPhoto` of `photo.rs` has the same layout in Rust.
struct Photo {
    /// Row of the rotation into the camera's axes; x of the camera's centre.
    row_x: vec4<f32>,
    /// Same for y.
    row_y: vec4<f32>,
    /// Same for z.
    row_z: vec4<f32>,
    /// fx fy cx cy. [px]
    focal: vec4<f32>,
    /// Bounds of the slopes at which a splat is linearised: minimum x, y, maximum x, y.
    slopes: vec4<f32>,
    /// Width, height [px], tiles across, tiles.
    size: vec4<u32>,
    /// Number of rows, values of each, degree of the harmonics to use, 1 if anti-aliased.
    rows: vec4<u32>,
    /// Near plane; unused.
    near: vec4<f32>,
}

@group(0) @binding(0) var<uniform> photo: Photo;
