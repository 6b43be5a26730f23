//! Text of edit steps, in the syntax of the command line where it has one.

use std::fmt;

use super::{Axis, EditStep, Region};

impl fmt::Display for EditStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Crop { within } => regions(f, "crop", within),
            Self::Remove { within } => regions(f, "remove", within),
            Self::Faint { below } => write!(f, "min-opacity {below}"),
            Self::Large { above } => write!(f, "max-size {above}"),
            Self::Small { below } => write!(f, "min-size {below}"),
            Self::Floaters { cell, least } => write!(f, "drop-floaters {cell}:{least}"),
            Self::Parts { cell, keep } => write!(f, "keep-parts {cell}:{keep}"),
            Self::Carve(carve) => {
                write!(f, "carve {}", point(carve.path[0]))?;
                if carve.path.len() > 1 {
                    write!(f, " and {} more points", carve.path.len() - 1)?;
                }
                write!(f, ", radius {}, depth {}", carve.radius, carve.depth)?;
                write!(f, ", cell {}, reach {}", carve.cell, carve.reach)
            }
            Self::Decimate { count } => write!(f, "decimate {count}"),
            Self::Turn { rotation: [x, y, z, w] } => {
                write!(f, "turn by quaternion {x},{y},{z},{w}")
            }
            Self::Scale { factor } => write!(f, "scale {factor}"),
            Self::Move { by } => write!(f, "move {}", point(*by)),
        }
    }
}

fn regions(f: &mut fmt::Formatter<'_>, verb: &str, within: &[Region]) -> fmt::Result {
    for (index, region) in within.iter().enumerate() {
        let before = if index == 0 { "" } else { " and " };
        write!(f, "{before}{verb}-{region}")?;
    }
    Ok(())
}

impl fmt::Display for Region {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Box { min, max } => write!(f, "box {}:{}", point(*min), point(*max)),
            Self::Sphere { center, radius } => write!(f, "sphere {}:{radius}", point(*center)),
            Self::Prism { axis, outline, low, high } => {
                let axis = match axis {
                    Axis::X => "x",
                    Axis::Y => "y",
                    Axis::Z => "z",
                };
                write!(f, "prism {axis}:{low},{high}")?;
                outline.iter().try_for_each(|[u, v]| write!(f, ":{u},{v}"))
            }
            Self::View { eye, outline, visible, .. } => {
                let what = if *visible { ", visible splats only" } else { "" };
                let [x, y, z] = eye;
                write!(f, "lasso of {} corners from {x:.3},{y:.3},{z:.3}{what}", outline.len())
            }
        }
    }
}

fn point([x, y, z]: [f64; 3]) -> String {
    format!("{x},{y},{z}")
}
