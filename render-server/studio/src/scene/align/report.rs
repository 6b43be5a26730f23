//! Report of an alignment, for the command line and the page.

use vizflyt_arena::config::Geofence;
use vizflyt_server::web::Line;
use vizflyt_twin::align::{Fit, Similarity};

/// Lines of the report, and whether the alignment is accurate enough.
pub(super) struct PlacementReport {
    pub lines: Vec<Line>,
    pub is_known: bool,
}

/// Returns the report of an alignment: its uncertainty, and whether its error within the fence is at most `allow_m`.
pub(super) fn report(fit: &Fit, fence: &Geofence, allow_m: f64) -> PlacementReport {
    let bound_m = fit.bound_within_m(fence.min_m, fence.max_m);
    let is_known = bound_m <= allow_m;
    let Similarity { scale, rotation, translation_m: p_m } = fit.world_from_scene;
    let [x, y, z, w] = rotation.to_array();
    let (tilt_deg, yaw_deg) = (fit.tilt_sigma_rad.to_degrees(), fit.yaw_sigma_rad.to_degrees());
    let line = |key, text| Line { key, text };
    let mut lines = vec![
        line("scale", format!("{scale:.6} m per unit, to {:.2} %", 3e2 * fit.scale_sigma)),
        line("rotation", format!("{x:.5}, {y:.5}, {z:.5}, {w:.5} (x, y, z, w)")),
        line("tilt", format!("to {:.2} degrees, heading to {:.2}", 3.0 * tilt_deg, 3.0 * yaw_deg)),
        line("origin", format!("{:.3}, {:.3}, {:.3} m", p_m.x, p_m.y, p_m.z)),
        line(
            "residual",
            format!(
                "{:.2} cm rms, {:.2} cm maximum, over {} points; {} rejected",
                fit.rms_m * 1e2,
                fit.worst_m * 1e2,
                fit.used,
                fit.left_out
            ),
        ),
        line("bound", format!("{:.1} cm within the fence, at three sigmas", bound_m * 1e2)),
    ];
    lines.push(if is_known {
        line("go", format!("the error of the twin within the fence is at most {:.1} cm", bound_m * 1e2))
    } else {
        line(
            "NO GO",
            format!(
                "the error of the twin within the fence can reach {:.1} cm; {:.1} are allowed (--allow-m): use points \
                 farther apart, more tags, or a smaller fence",
                bound_m * 1e2,
                allow_m * 1e2
            ),
        )
    });
    PlacementReport { lines, is_known }
}
