//! Textures of the hall: painted walls, posters, screens, view through windows, bricks.

use glam::{DVec2, DVec3};

use super::panel::Look;
use crate::canvas::paint;
use crate::random::{Rng, fractal2, noise2, smoothstep};

/// Returns the colour of a bare wall: pale above a painted dado with a stripe.
pub(crate) fn wall(seed: u64, p: DVec2) -> DVec3 {
    let dado = [0x4d6f8a, 0x5a7a5e, 0x7d5a52, 0x5c6272][(seed % 4) as usize];
    let stain = 0.92 + 0.16 * fractal2(seed ^ 0x51, p / 1.3, 3);
    let seam = (p.x / 1.7 - (p.x / 1.7).round()).abs() * 1.7 < 0.012 && p.y > 1.25;
    let base = if p.y < 0.12 {
        paint(0x3a3b3d)
    } else if p.y < 1.15 {
        paint(dado)
    } else if p.y < 1.25 {
        paint(0xe9e6df)
    } else {
        paint(0xd3cfc4)
    };
    base * stain * if seam { 0.72 } else { 1.0 }
}

/// Returns the wall with its posters, boards and doors; `side` is the number of the wall.
pub(crate) fn with_pictures(seed: u64, side: u64, p: DVec2) -> Look {
    for (n, picture) in pictures(side).iter().enumerate() {
        let (min, size) = (DVec2::new(picture.x_m, picture.y_m), picture.size_m);
        let q = (p - min) / size;
        if q.cmplt(DVec2::ZERO).any() || q.cmpgt(DVec2::ONE).any() {
            continue;
        }
        let key = seed ^ (side * 1000 + n as u64 * 13);
        let edge_m = ((q.min(DVec2::ONE - q)) * size).min_element();
        return match picture.kind {
            Hanging::Poster => Look::matt(poster(key, q, edge_m)),
            Hanging::Whiteboard => Look::matt(whiteboard(key, q, edge_m)),
            Hanging::Door => Look::matt(door(q, edge_m)),
            Hanging::Banner => Look::matt(banner(key, q)),
            Hanging::Screen => screen(key, q),
        };
    }
    Look::matt(wall(seed, p))
}

/// Kind of object on a wall.
#[derive(Clone, Copy, Debug)]
enum Hanging {
    Poster,
    Whiteboard,
    Door,
    Banner,
    Screen,
}

struct Picture {
    kind: Hanging,
    x_m: f64,
    y_m: f64,
    size_m: DVec2,
}

const fn picture(kind: Hanging, x_m: f64, y_m: f64, width_m: f64, height_m: f64) -> Picture {
    Picture { kind, x_m, y_m, size_m: DVec2::new(width_m, height_m) }
}

fn pictures(side: u64) -> &'static [Picture] {
    const SOUTH: [Picture; 9] = [
        picture(Hanging::Poster, 1.0, 1.7, 0.9, 1.25),
        picture(Hanging::Poster, 2.2, 1.7, 0.9, 1.25),
        picture(Hanging::Whiteboard, 3.9, 1.4, 2.4, 1.3),
        picture(Hanging::Poster, 7.0, 2.3, 1.2, 0.85),
        picture(Hanging::Banner, 8.8, 3.3, 4.2, 0.9),
        picture(Hanging::Whiteboard, 9.2, 1.4, 2.0, 1.2),
        picture(Hanging::Poster, 12.0, 1.7, 0.9, 1.25),
        picture(Hanging::Poster, 13.2, 1.7, 0.9, 1.25),
        picture(Hanging::Door, 15.0, 0.0, 1.1, 2.15),
    ];
    const EAST: [Picture; 5] = [
        picture(Hanging::Banner, 2.6, 3.6, 4.8, 1.0),
        picture(Hanging::Screen, 3.9, 1.75, 2.2, 1.3),
        picture(Hanging::Poster, 1.0, 1.6, 1.1, 1.5),
        picture(Hanging::Poster, 7.1, 1.6, 1.1, 1.5),
        picture(Hanging::Door, 8.6, 0.0, 1.1, 2.15),
    ];
    const WEST: [Picture; 4] = [
        picture(Hanging::Whiteboard, 3.4, 1.4, 2.8, 1.3),
        picture(Hanging::Poster, 1.2, 1.6, 1.1, 1.5),
        picture(Hanging::Poster, 7.3, 1.6, 1.1, 1.5),
        picture(Hanging::Banner, 2.8, 3.5, 4.4, 0.9),
    ];
    match side {
        1 => &SOUTH,
        2 => &EAST,
        _ => &WEST,
    }
}

fn poster(key: u64, q: DVec2, edge_m: f64) -> DVec3 {
    const INKS: [[u32; 3]; 6] = [
        [0x17355e, 0xe8b13c, 0xf2ead6],
        [0xb5322a, 0xf3e6c8, 0x2a2320],
        [0x1f6f63, 0xf0d9a0, 0xe2683c],
        [0x2b2b33, 0xd84a8a, 0x53c6d8],
        [0xe9e3d3, 0x2e5da8, 0xc8402f],
        [0xd98a2b, 0x3a2418, 0xf5efe0],
    ];
    let mut rng = Rng::new(key, 0);
    let ink = INKS[rng.below(INKS.len())].map(paint);
    if edge_m < 0.03 {
        return paint(0xf0eee8);
    }
    // A title, a shape, and lines of text.
    if q.y > 0.84 && q.y < 0.93 && q.x > 0.1 && q.x < rng.range(0.6, 0.9) {
        return ink[1];
    }
    if q.y < 0.26 && q.y > 0.07 && q.x > 0.1 && q.x < 0.9 {
        let line = (q.y - 0.07) / 0.19 * 4.0;
        let end = 0.55 + 0.35 * noise2(key, DVec2::new(line.floor() * 7.3, 0.5));
        return if line.fract() < 0.5 && q.x < end { ink[2] } else { ink[0] };
    }
    let c = q - DVec2::new(0.5, 0.54);
    let within = match rng.below(4) {
        0 => c.length() < 0.24,
        1 => c.x.abs() + c.y.abs() < 0.3,
        2 => c.length() < 0.26 && ((c.x + c.y) * 14.0).rem_euclid(1.0) < 0.55,
        _ => c.length() < 0.27 && c.length() > 0.15 || c.length() < 0.07,
    };
    if within { ink[1] } else { ink[0] * (0.8 + 0.5 * q.y) }
}

fn whiteboard(key: u64, q: DVec2, edge_m: f64) -> DVec3 {
    if edge_m < 0.04 {
        return paint(0x8f9297);
    }
    // Curves in three pens, and a few lines of notes.
    for (n, pen) in [0x2346a0, 0xb52b2b, 0x1f7a3c].into_iter().enumerate() {
        let base = 0.3 + 0.2 * n as f64;
        let y = base + 0.28 * (noise2(key ^ n as u64, DVec2::new(q.x * 5.0, 0.0)) - 0.5);
        if q.x > 0.05 && q.x < 0.55 && (q.y - y).abs() < 0.018 {
            return paint(pen);
        }
    }
    if q.x > 0.62 && q.x < 0.94 && q.y > 0.15 && q.y < 0.85 {
        let line = q.y * 9.0;
        let end = 0.7 + 0.24 * noise2(key ^ 9, DVec2::new(line.floor() * 3.7, 1.5));
        if line.fract() < 0.28 && q.x < end {
            return paint(0x30343c);
        }
    }
    paint(0xeceeee)
}

fn door(q: DVec2, edge_m: f64) -> DVec3 {
    if edge_m < 0.07 && q.y > 0.02 {
        return paint(0x55585c);
    }
    let glass = (q.x - 0.5).abs() < 0.12 && (0.55..0.85).contains(&q.y);
    let handle = (0.82..0.9).contains(&q.x) && (0.44..0.48).contains(&q.y);
    if glass {
        paint(0x2c3a44)
    } else if handle {
        paint(0xd9dadb)
    } else {
        paint(0x9a4f2e)
    }
}

fn banner(key: u64, q: DVec2) -> DVec3 {
    // V I Z F L Y T, five dots wide and seven high, the top row first; bit 4 is the left dot.
    const LETTERS: [[u8; 7]; 7] = [
        [0x11, 0x11, 0x11, 0x11, 0x11, 0x0a, 0x04],
        [0x0e, 0x04, 0x04, 0x04, 0x04, 0x04, 0x0e],
        [0x1f, 0x01, 0x02, 0x04, 0x08, 0x10, 0x1f],
        [0x1f, 0x10, 0x10, 0x1e, 0x10, 0x10, 0x10],
        [0x10, 0x10, 0x10, 0x10, 0x10, 0x10, 0x1f],
        [0x11, 0x11, 0x0a, 0x04, 0x04, 0x04, 0x04],
        [0x1f, 0x04, 0x04, 0x04, 0x04, 0x04, 0x04],
    ];
    let mut rng = Rng::new(key, 1);
    let (back, front) =
        [(0x9c1f2b, 0xf4f1ea), (0x1d3f7c, 0xf0c23b), (0x20242b, 0x44c5e0)][rng.below(3)];
    let at = (q - DVec2::new(0.09, 0.2)) / DVec2::new(0.82, 0.6);
    let dot = DVec2::new(at.x * 41.0, (1.0 - at.y) * 7.0).floor();
    let inside = at.cmpge(DVec2::ZERO).all() && at.cmplt(DVec2::ONE).all();
    let (letter, column) = ((dot.x / 6.0) as usize, dot.x as usize % 6);
    let lit = inside
        && column < 5
        && LETTERS.get(letter).is_some_and(|rows| {
            rows.get(dot.y as usize).is_some_and(|row| (row >> (4 - column)) & 1 == 1)
        });
    paint(if lit { front } else { back })
}

/// Returns the content of a monitor: windows with plots.
pub(crate) fn screen(key: u64, q: DVec2) -> Look {
    let edge = q.min(DVec2::ONE - q).min_element();
    if edge < 0.035 {
        return Look::matt(paint(0x141518));
    }
    let plot = 0.45 + 0.3 * (noise2(key, DVec2::new(q.x * 9.0, 0.0)) - 0.5);
    let colour = if q.y > 0.88 {
        paint(0x3b6fb5)
    } else if (q.y - plot).abs() < 0.03 {
        paint(0xf2b53c)
    } else if q.y < plot && q.x < 0.6 {
        paint(0x245a4c)
    } else if q.x > 0.66 && (q.y * 8.0).fract() < 0.45 {
        paint(0x8fa6bf)
    } else {
        paint(0x1b2530)
    };
    Look { albedo: DVec3::splat(0.03), glow: colour * 1.1 }
}

/// Returns the light through a window: sky above trees and lawn.
pub(crate) fn outside(seed: u64, p: DVec2) -> DVec3 {
    let crown_m = 2.1 + 0.9 * fractal2(seed ^ 0x61, DVec2::new(p.x / 1.1, 0.0), 3);
    let leaf = fractal2(seed ^ 0x62, p / 0.32, 2);
    if p.y > crown_m {
        let up = smoothstep(1.6, 4.2, p.y);
        let cloud = smoothstep(0.52, 0.7, fractal2(seed ^ 0x63, p / DVec2::new(1.6, 0.6), 3));
        paint(0xdbe9f2).lerp(paint(0x8fbce8), up).lerp(DVec3::splat(1.05), cloud * 0.7) * 1.35
    } else if p.y > 1.72 {
        paint(0x3f5d2a).lerp(paint(0x9bb35a), leaf) * 1.1
    } else {
        paint(0x8fb052) * (0.9 + 0.4 * leaf)
    }
}

/// Returns the colour of the wall with a gap: bricks with spray paint.
pub(crate) fn bricks(seed: u64, p: DVec2) -> DVec3 {
    let course = (p.y / 0.16).floor();
    let shift = if course as i64 % 2 == 0 { 0.0 } else { 0.17 };
    let along = (p.x + shift) / 0.34;
    let mortar = (along - along.round()).abs() * 0.34 < 0.011
        || ((p.y / 0.16) - (p.y / 0.16).round()).abs() * 0.16 < 0.011;
    let tone = noise2(seed ^ 0x71, DVec2::new(along.floor() * 3.1, course * 5.7));
    let brick = paint(0x7d3b2a).lerp(paint(0xb8664a), tone);
    let spray = fractal2(seed ^ 0x72, p / 0.9, 3);
    let colours = [0x2fa4c7, 0xe8c02f, 0xd6408f, 0x57b04a];
    let field = noise2(seed ^ 0x73, p / 1.2);
    let ink = paint(colours[((field * 4.0) as usize).min(3)]);
    let wall = if mortar { paint(0xb9ada0) } else { brick };
    wall.lerp(ink, 0.85 * smoothstep(0.53, 0.57, spray))
}
