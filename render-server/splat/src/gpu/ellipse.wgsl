// Ellipse of a splat on the image plane, on which its alpha is 1/255.

struct Ellipse {
    mean: vec2<f32>,
    shear: f32,
    falloff: vec2<f32>,
    /// Level above the minimum visible level.
    reach: f32,
    /// dy of the rightmost point. [px]
    tip_y: f32,
}

/// Returns the x of the left (-1) or right (1) edge at a height. [px]
fn edge(e: Ellipse, dy: f32, side: f32) -> f32 {
    let left = max(e.reach - e.falloff.y * dy * dy, 0.0);
    return e.mean.x + e.shear * dy + side * sqrt(left / e.falloff.x);
}

/// Returns the minimum and maximum x between two heights that the ellipse reaches. [px]
fn band(e: Ellipse, top: f32, bottom: f32) -> vec2<f32> {
    // The outermost points are the tips of the ellipse, or its intersection with the band's edge nearest to them.
    let low = clamp(-e.tip_y, top - e.mean.y, bottom - e.mean.y);
    let high = clamp(e.tip_y, top - e.mean.y, bottom - e.mean.y);
    return vec2(edge(e, low, -1.0), edge(e, high, 1.0));
}

/// Returns the pixels whose centres are between `low` and `high`: first and end. [px]
fn centres(low: f32, high: f32, size: f32) -> vec2<u32> {
    return vec2<u32>(
        u32(ceil(clamp(low - 0.5, 0.0, size))),
        u32(floor(clamp(high + 0.5, 0.0, size))),
    );
}
