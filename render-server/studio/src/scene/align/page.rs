//! Alignment by clicks on a page. The server provides the points; this module solves for the placement and writes it.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use glam::{DQuat, DVec3};
use vizflyt_arena::ArenaConfig;
use vizflyt_process::print_line;
use vizflyt_server::ViewArgs;
use vizflyt_server::render::DetailKind;
use vizflyt_server::scene::{Antialiased, BareArgs, Placement, WorldFromScene};
use vizflyt_server::web::{self, Aligner, Line, Picks, Place, Solved, Wish};
use vizflyt_twin::align::floor::{self, Floor};
use vizflyt_twin::align::{Fit, Similarity};

use super::report::{PlacementReport, report};
use super::write::{self, Changes};
use super::{AlignArgs, CROP, LENGTH_SHARE};
use crate::page::show_page;

/// Serves the page until it is interrupted.
pub(super) fn run(args: &AlignArgs, path: &Path) -> Result<()> {
    let view = ViewArgs {
        scene: path.to_owned(),
        http: args.http,
        renderer: args.renderer,
        detail: DetailKind::default(),
        antialiased: Antialiased::default(),
        bare: BareArgs::default(),
        seed: 0,
        no_browser: args.no_browser,
    };
    let clicked = Clicked {
        path: path.to_owned(),
        click_sigma_m: args.sigma_mm * 1e-3,
        allow_m: args.allow_m,
    };
    web::align(view, Arc::new(clicked), show_page(args.no_browser))
}

/// Solver for the clicked points of an arena.
struct Clicked {
    path: PathBuf,
    click_sigma_m: f64,
    allow_m: f64,
}

impl Clicked {
    fn arena(&self) -> Result<ArenaConfig> {
        let text = std::fs::read_to_string(&self.path)
            .with_context(|| format!("cannot read {}", self.path.display()))?;
        ArenaConfig::parse(&text).with_context(|| self.path.display().to_string())
    }

    /// Returns the placement, and whether its scale is known.
    fn fit(&self, picks: &Picks) -> Result<(Fit, bool)> {
        let length = match (&picks.length, picks.floor.as_slice()) {
            (Some(length), _) => (length.ends, length.metres),
            // Until a length is known, the current scale is kept.
            (None, &[from, to, ..]) => {
                let unit_m = Placement::of(&self.arena()?.scene).world_from_scene.scale;
                ([from, to], from.distance(to) * unit_m)
            }
            (None, _) => ([DVec3::ZERO, DVec3::X], 1.0),
        };
        let (ends, length_m) = length;
        let fit = floor::fit(&Floor {
            points: picks.floor.clone(),
            above: picks.above,
            length: ends,
            length_m,
            length_sigma_m: LENGTH_SHARE * length_m,
            click_sigma_m: self.click_sigma_m.max(picks.rough_m),
        })?;
        Ok((in_room(fit, picks), picks.length.is_some()))
    }
}

impl Aligner for Clicked {
    fn solve(&self, picks: &Picks) -> Result<Solved, String> {
        let (fit, has_scale) = self.fit(picks).map_err(in_words)?;
        let place = place(&fit.world_from_scene);
        let PlacementReport { mut lines, is_known } = report(&fit, &picks.geofence, self.allow_m);
        if !has_scale {
            // Without a known scale, values in metres are meaningless.
            lines.clear();
            let text = "unknown: click both ends of a measured length".to_owned();
            lines.push(Line { key: "scale", text });
        }
        Ok(Solved { place, lines, go: has_scale.then_some(is_known) })
    }

    fn save(&self, wish: &Wish) -> Result<Vec<Line>, String> {
        let (fit, has_scale) = self.fit(&wish.picks).map_err(in_words)?;
        if !has_scale {
            return Err("first click both ends of a measured length".to_owned());
        }
        let PlacementReport { mut lines, is_known } =
            report(&fit, &wish.picks.geofence, self.allow_m);
        if !(is_known || wish.force) {
            return Err(lines.pop().map_or_else(String::new, |last| last.text));
        }
        let arena = self.arena().map_err(in_words)?;
        let fence = wish.picks.geofence;
        let changes = Changes {
            place: fit.world_from_scene,
            fence: (fence != arena.geofence).then_some(fence),
            spawn: (wish.spawn != arena.spawn).then_some(wish.spawn),
        };
        write::write(&self.path, &changes).map_err(in_words)?;
        let path = self.path.display();
        print_line(format!("written     {path}"));
        let mut said = vec![Line { key: "written", text: path.to_string() }];
        if arena.scene.crop.is_some() {
            said.push(Line { key: "note", text: CROP.to_owned() });
        }
        said.push(Line { key: "next", text: format!("vizflyt arena check {path}") });
        Ok(said)
    }
}

/// Rotates and moves a placement with the origin at the first point of the floor, as requested in `picks`.
fn in_room(mut fit: Fit, picks: &Picks) -> Fit {
    let turn = DQuat::from_rotation_z(picks.yaw_deg.to_radians());
    let by_m = picks.origin_at_m;
    let Similarity { rotation, translation_m, .. } = &mut fit.world_from_scene;
    *rotation = (turn * *rotation).normalize();
    *translation_m = turn * *translation_m + by_m;
    fit.middle_m = turn * fit.middle_m + by_m;
    fit
}

fn place(similarity: &Similarity) -> Place {
    let Similarity { scale, rotation, translation_m } = *similarity;
    Place::new(&WorldFromScene { scale, rotation, translation_m })
}

#[allow(clippy::needless_pass_by_value)] // Why: signature for map_err.
fn in_words(error: anyhow::Error) -> String {
    format!("{error:#}")
}

#[cfg(test)]
mod tests {
    use vizflyt_arena::config::{Geofence, Spawn};
    use vizflyt_server::web::Length;

    use super::*;

    const ARENA: &str = "name = \"hall\"\nscene = \"a.ply\" # captured\nbody_radius_m = 0.12\ntakeoff_height_m = 1.0\n\
        spawn = { position_m = [1, 1, 0] }\ngeofence = { min_m = [-1, -1, -0.5], max_m = [5, 4, 3] } # the net\n\
        limits = { max_speed_mps = 2.0, max_acceleration_mps2 = 4.0 }\n\
        cameras = [{ name = \"front\", width_px = 64, height_px = 48, horizontal_fov_deg = 90, position_m = [0, 0, 0] }]\n";

    /// Returns the picks of a floor of 4 by 3 m, in a file with 2 m per unit and y down.
    fn picks() -> Picks {
        let scene = |x: f64, y: f64, z: f64| DVec3::new(x, -z, y) / 2.0;
        Picks {
            floor: vec![
                scene(0.0, 0.0, 0.0),
                scene(4.0, 0.0, 0.0),
                scene(4.0, 3.0, 0.0),
                scene(0.0, 3.0, 0.0),
            ],
            above: scene(2.0, 1.0, 1.5),
            length: Some(Length {
                ends: [scene(1.0, 1.0, 0.0), scene(1.0, 1.0, 2.0)],
                metres: 2.0,
            }),
            origin_at_m: DVec3::new(0.5, -0.25, 0.7),
            yaw_deg: 90.0,
            geofence: Geofence {
                min_m: DVec3::new(-3.0, -1.0, -0.5),
                max_m: DVec3::new(1.0, 4.0, 2.5),
            },
            rough_m: 0.0,
        }
    }

    #[test]
    fn solves_and_saves_the_clicked_points() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("arena.toml");
        std::fs::write(&path, ARENA).unwrap();
        let clicked = Clicked { path: path.clone(), click_sigma_m: 0.005, allow_m: 0.1 };
        let (fit, has_scale) = clicked.fit(&picks()).unwrap();
        // The second point lies 4 m along y from the chosen origin.
        let second_m = fit.world_from_scene.transform_point(picks().floor[1]);
        assert!(has_scale && second_m.distance(DVec3::new(0.5, 3.75, 0.7)) < 1e-9, "{second_m}");
        let solved = clicked.solve(&picks()).unwrap();
        assert_eq!(solved.go, Some(true), "{solved:?}");
        assert!(solved.lines.iter().any(|line| line.key == "residual"));
        let spawn = Spawn { position_m: DVec3::new(-1.0, 2.0, 0.0), yaw_deg: 45.0 };
        let wish = Wish { picks: picks(), spawn, force: false };
        clicked.save(&wish).unwrap();
        let written = std::fs::read_to_string(&path).unwrap();
        assert!(written.contains("# the net"), "{written}");
        let arena = ArenaConfig::parse(&written).unwrap();
        assert_eq!((arena.geofence, arena.spawn), (picks().geofence, spawn));
        let placed = Placement::of(&arena.scene).world_from_scene;
        assert!((placed.scale - 2.0).abs() < 1e-9);
        let back_m = placed.rotation * picks().floor[1] * placed.scale + placed.translation_m;
        assert!(back_m.distance(second_m) < 1e-9);
        // A start outside the fence makes the arena invalid: nothing is written.
        let outside = Spawn { position_m: DVec3::splat(90.0), yaw_deg: 0.0 };
        let why = clicked.save(&Wish { spawn: outside, ..wish }).unwrap_err();
        assert!(why.contains("spawn"), "{why}");
        assert_eq!(std::fs::read_to_string(&path).unwrap(), written);
    }

    #[test]
    fn saves_nothing_that_is_too_uncertain() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("arena.toml");
        std::fs::write(&path, ARENA).unwrap();
        let clicked = Clicked { path: path.clone(), click_sigma_m: 0.05, allow_m: 0.1 };
        let spawn = Spawn { position_m: DVec3::ZERO, yaw_deg: 0.0 };
        let save = |picks: Picks, force| clicked.save(&Wish { picks, spawn, force });
        let no_length = Picks { length: None, ..picks() };
        assert_eq!(clicked.solve(&no_length).unwrap().go, None);
        assert!(save(no_length, true).unwrap_err().contains("length"));
        assert_eq!(clicked.solve(&picks()).unwrap().go, Some(false));
        assert!(save(picks(), false).unwrap_err().contains("allowed"));
        let few = Picks { floor: picks().floor[..2].to_vec(), ..picks() };
        assert!(clicked.solve(&few).unwrap_err().contains("at least 3"));
        assert_eq!(std::fs::read_to_string(&path).unwrap(), ARENA);
        save(picks(), true).unwrap();
    }
}
