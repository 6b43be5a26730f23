//! `vizflyt scene edit --page`: the view, with a lasso and a box that select what goes.
//!
//! ```text
//! GET  /edit.js, /edit.css    the panel
//! POST /api/edit              Order -> Report: what is selected, what was done, in words
//! ```
//! A selection is an outline in a picture with the camera that showed it; which splats lie in it is found here. It is shown
//! by their colour. Deleting makes a step of it, as the command line makes them; saving writes the list and the result. Naming
//! puts the box about it into the scene's file of parts, at once. Only a browser on this computer, on a page of ours, may
//! edit.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};

use anyhow::{Result, ensure};
use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::extract::{ConnectInfo, DefaultBodyLimit, State};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use axum::{Json, Router};
use glam::DVec2;
use serde::{Deserialize, Serialize};
use vizflyt_splat::edit::{EditStep, Region, select};
use vizflyt_splat::harmonics::C0;
use vizflyt_splat::{Chosen, Rasterizer, RigidObject, Splats};

use super::args::ViewArgs;
use super::engine::{Engine, Request};
use crate::render::choose;
use crate::scene::{BoxedPart, Editor, PartsFile, Placement, parts_path};
use crate::web::http::{file, ordered_here};
use vizflyt_process::lock;

/// The panel's part of the view's state.
pub(super) struct Panel {
    pub(super) engine: Arc<Mutex<Engine>>,
    pub(super) session: Mutex<Session>,
}

/// A scene under edit, and what is selected of it.
pub(super) struct Session {
    editor: Editor,
    output: PathBuf,
    args: ViewArgs,
    placement: Placement,
    objects: Vec<RigidObject>,
    parts: PartsFile,
    regions: Vec<Region>,
    is_inverted: bool,
    is_saved: bool,
}

/// What the page asks for.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Order {
    /// Nothing but a report.
    Report,
    /// Selects what a picture shows within an outline.
    Select(Outline),
    /// Selects what is not selected.
    Invert,
    /// Selects nothing.
    Clear,
    /// Removes what is selected.
    Delete,
    /// Takes the last step back.
    Undo,
    /// Writes result and list.
    Save,
    /// Calls what is selected a part of the scene.
    Name {
        /// What it is called.
        name: String,
        /// Its class.
        class: String,
    },
}

/// An outline in a picture.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Outline {
    /// What the picture shows.
    request: Request,
    /// Corners, as shares of its width and height.
    corners: Vec<[f64; 2]>,
    /// Only what is in front.
    visible: bool,
    /// Beside what is selected already.
    adds: bool,
}

/// What the page shows.
#[derive(Debug, Serialize)]
struct EditState {
    splats: usize,
    selected: usize,
    /// In words, in order.
    steps: Vec<String>,
    /// Named parts, in words.
    parts: Vec<String>,
    saved: bool,
    /// Where the result goes.
    output: String,
    /// What was done, for a person.
    said: String,
}

impl Session {
    pub(super) fn new(
        editor: Editor,
        output: PathBuf,
        args: ViewArgs,
        placement: Placement,
        objects: Vec<RigidObject>,
    ) -> Result<Self> {
        let (regions, is_inverted, is_saved) = (Vec::new(), false, true);
        let path = parts_path(editor.original());
        let parts = if path.exists() { PartsFile::read(&path)? } else { PartsFile::default() };
        Ok(Self { editor, output, args, placement, objects, parts, regions, is_inverted, is_saved })
    }

    /// Does what the page asks for; returns what was done, and whether the picture changes.
    fn obey(&mut self, order: Order) -> Result<(String, bool)> {
        match order {
            Order::Report => Ok((String::new(), false)),
            Order::Select(outline) => {
                let region = self.region(&outline);
                let whole = EditStep::Remove { within: vec![region.clone()] };
                whole.check()?;
                if !outline.adds || self.is_inverted {
                    self.regions.clear();
                    self.is_inverted = false;
                }
                self.regions.push(region);
                Ok((String::new(), true))
            }
            Order::Invert => {
                ensure!(!self.regions.is_empty(), "nothing is selected");
                self.is_inverted ^= true;
                Ok((String::new(), true))
            }
            Order::Clear => {
                let had = !self.regions.is_empty();
                self.clear();
                Ok((String::new(), had))
            }
            Order::Delete => {
                ensure!(!self.regions.is_empty(), "nothing is selected");
                let within = self.regions.clone();
                let step = if self.is_inverted {
                    EditStep::Crop { within }
                } else {
                    EditStep::Remove { within }
                };
                let taken = self.editor.apply(step)?;
                self.clear();
                self.is_saved = false;
                Ok((format!("{taken} splats removed"), true))
            }
            Order::Undo => {
                let step = self.editor.undo()?;
                self.clear();
                self.is_saved = false;
                Ok((format!("taken back: {step}"), true))
            }
            Order::Save => {
                self.editor.save(&self.output)?;
                self.is_saved = true;
                Ok((format!("written: {}", self.output.display()), false))
            }
            Order::Name { name, class } => {
                ensure!(!self.regions.is_empty(), "nothing is selected");
                let marks = self.selected();
                let means =
                    self.editor.splats().means_m.iter().zip(marks).filter(|(_, mark)| *mark);
                let place = &self.placement.world_from_scene;
                let points_m: Vec<_> =
                    means.map(|(mean, _)| place.point_m(mean.as_dvec3())).collect();
                let part = BoxedPart::about(name.trim(), class.trim(), &points_m)?;
                let (said, path) = (part.to_string(), parts_path(self.editor.original()));
                self.parts.put(part, &path)?;
                self.clear();
                Ok((format!("{said}, in {}", path.display()), true))
            }
        }
    }

    fn clear(&mut self) {
        self.regions.clear();
        self.is_inverted = false;
    }

    /// Returns the region of the file's frame that an outline shows.
    fn region(&self, outline: &Outline) -> Region {
        let camera = outline.request.camera();
        let k = &camera.intrinsics;
        let size = DVec2::new(f64::from(k.width_px), f64::from(k.height_px));
        let slope = |corner: &[f64; 2]| {
            let px = DVec2::from(*corner) * size;
            [(px.x - k.cx_px) / k.fx_px, (px.y - k.cy_px) / k.fy_px]
        };
        let place = &self.placement.world_from_scene;
        let scene_from_world = place.rotation.conjugate();
        let eye_m = camera.world_from_cam.translation_m - place.translation_m;
        Region::View {
            eye: (scene_from_world * eye_m / place.scale).to_array(),
            rotation: (scene_from_world * camera.world_from_cam.rotation).to_array(),
            outline: outline.corners.iter().map(slope).collect(),
            visible: outline.visible,
        }
    }

    /// Marks what is selected.
    fn selected(&self) -> Vec<bool> {
        if self.regions.is_empty() {
            return vec![false; self.editor.splats().len()];
        }
        let mut marks = select(&self.regions, self.editor.splats());
        for mark in &mut marks {
            *mark ^= self.is_inverted;
        }
        marks
    }

    /// Returns a renderer of the scene in the world, what is selected in a colour of its own.
    fn renderer(&self, selected: &[bool]) -> Result<Box<dyn Rasterizer>> {
        let mut splats = self.editor.splats().clone();
        highlight(&mut splats, selected);
        self.placement.apply(&mut splats);
        self.args.antialiased.apply(&mut splats);
        let twin = vizflyt_splat::Scene { splats: &splats, objects: &self.objects };
        let Chosen { rasterizer, .. } = choose(twin, self.args.renderer, self.args.detail)?;
        Ok(rasterizer)
    }

    fn report(&self, selected: &[bool], said: String) -> EditState {
        EditState {
            splats: self.editor.splats().len(),
            selected: selected.iter().filter(|mark| **mark).count(),
            steps: self.editor.steps().iter().map(|done| done.edit.to_string()).collect(),
            parts: self.parts.parts.iter().map(BoxedPart::to_string).collect(),
            saved: self.is_saved,
            output: self.output.display().to_string(),
            said,
        }
    }
}

/// Mixes what is marked with a colour, seen from anywhere.
fn highlight(splats: &mut Splats, marks: &[bool]) {
    let width = splats.sh_coefficients() * 3;
    for (sh, _) in splats.sh.chunks_exact_mut(width).zip(marks).filter(|(_, mark)| **mark) {
        for (channel, colour) in HIGHLIGHT.into_iter().enumerate() {
            let constant = (colour - 0.5) / C0 as f32;
            sh[channel] = (1.0 - HIGHLIGHT_SHARE) * sh[channel] + HIGHLIGHT_SHARE * constant;
        }
        sh[3..].fill(0.0);
    }
}

/// The panel's files and orders.
pub(super) fn routes(panel: Panel) -> Router {
    Router::new()
        .route(
            "/edit.js",
            get(async || file("text/javascript; charset=utf-8", include_str!("page/edit.js"))),
        )
        .route(
            "/edit.css",
            get(async || file("text/css; charset=utf-8", include_str!("page/edit.css"))),
        )
        .route("/api/edit", post(edit))
        .layer(DefaultBodyLimit::max(MAX_ORDER))
        .with_state(Arc::new(panel))
}

async fn edit(
    State(panel): State<Arc<Panel>>,
    ConnectInfo(from): ConnectInfo<SocketAddr>,
    headers: HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Response {
    const WHY: &str = "only a browser on the computer that serves the page may edit";
    let order = match ordered_here(from, WHY, &headers, body) {
        Ok(order) => order,
        Err(refusal) => return *refusal,
    };
    match tokio::task::spawn_blocking(move || obey(&panel, order)).await {
        Ok(Ok(report)) => Json(report).into_response(),
        Ok(Err(error)) => (StatusCode::CONFLICT, format!("{error:#}")).into_response(),
        Err(_) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

fn obey(panel: &Panel, order: Order) -> Result<EditState> {
    let mut session = lock(&panel.session);
    let (said, is_changed) = session.obey(order)?;
    let selected = session.selected();
    if is_changed {
        let renderer = session.renderer(&selected)?;
        lock(&panel.engine).replace(renderer);
    }
    Ok(session.report(&selected, said))
}

/// An outline of 2000 corners has 80 kB. [byte]
const MAX_ORDER: usize = 256 << 10;
/// Orange: rare in rooms, and seen in the dark. [linear RGB]
const HIGHLIGHT: [f32; 3] = [1.0, 0.35, 0.0];
/// What is left shows what is selected.
const HIGHLIGHT_SHARE: f32 = 0.7;

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use glam::{DQuat, DVec3, Quat, Vec3};
    use vizflyt_splat::ply;

    use crate::scene::WorldFromScene;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        view: ViewArgs,
    }

    /// A row of splats along the world's y, 4 m ahead of the camera, in a file of another frame.
    fn session(folder: &std::path::Path) -> (Session, WorldFromScene) {
        let place = WorldFromScene {
            scale: 2.0,
            rotation: DQuat::from_rotation_x(1.0) * DQuat::from_rotation_z(-0.7),
            translation_m: DVec3::new(0.3, -2.0, 1.0),
        };
        let to_file =
            |p: DVec3| place.rotation.conjugate() * (p - place.translation_m) / place.scale;
        let count = 21;
        let in_world = |k: usize| DVec3::new(4.0, 0.2 * (k as f64 - 10.0), 1.0);
        let splats = Splats {
            means_m: (0..count).map(|k| to_file(in_world(k)).as_vec3()).collect(),
            scales_m: vec![Vec3::splat(0.02); count],
            rotations: vec![Quat::IDENTITY; count],
            opacities: vec![0.9; count],
            sh_degree: 0,
            sh: vec![0.3; count * 3],
            antialiased: false,
        };
        let scene = folder.join("row.ply");
        ply::write(&scene, &splats).unwrap();
        let args = Cli::try_parse_from(["view", "row.ply", "--renderer", "cpu"]).unwrap().view;
        let placement = Placement { world_from_scene: place, crop: None };
        let editor = Editor::open(&scene).unwrap();
        let output = folder.join("out.ply");
        (Session::new(editor, output, args, placement, Vec::new()).unwrap(), place)
    }

    /// An order as the page writes it: what the left half of the picture shows, and a little more.
    fn left_half(adds: bool, right: bool) -> Order {
        let (low, high) = if right { (0.5, 1.0) } else { (0.0, 0.52) };
        let order = serde_json::json!({"select": {
            "request": {
                "p_m": [0, 0, 1], "yaw_rad": 0, "pitch_rad": 0, "fov_deg": 90, "width_px": 640,
                "height_px": 480, "depth": false, "at_s": 0,
            },
            "corners": [[low, 0.4], [high, 0.4], [high, 0.6], [low, 0.6]],
            "visible": true,
            "adds": adds,
        }});
        serde_json::from_value(order).unwrap()
    }

    #[test]
    fn what_the_outline_shows_is_selected_deleted_taken_back_and_saved() {
        let folder = tempfile::tempdir().unwrap();
        let (mut session, _) = session(folder.path());
        let count = |session: &Session| session.selected().iter().filter(|mark| **mark).count();
        assert!(session.obey(Order::Delete).is_err() && session.obey(Order::Undo).is_err());
        // Left is +y: ten of them, and the middle one.
        session.obey(left_half(false, false)).unwrap();
        assert_eq!(count(&session), 11);
        assert!(session.selected()[10] && session.selected()[20] && !session.selected()[9]);
        session.obey(left_half(true, true)).unwrap();
        assert_eq!(count(&session), 21);
        session.obey(left_half(false, false)).unwrap();
        session.obey(Order::Invert).unwrap();
        assert_eq!(count(&session), 10);
        let marks = session.selected();
        assert!(session.renderer(&marks).is_ok());
        assert_eq!(session.obey(Order::Delete).unwrap().0, "10 splats removed");
        assert_eq!(
            (session.editor.splats().len(), count(&session), session.is_saved),
            (11, 0, false)
        );
        session.obey(left_half(false, true)).unwrap();
        session.obey(Order::Delete).unwrap();
        session.obey(Order::Undo).unwrap();
        session.obey(Order::Save).unwrap();
        assert!(session.is_saved);
        let saved = vizflyt_splat::format::read(folder.path().join("out.ply")).unwrap();
        assert_eq!(saved.splats.len(), 11);
        assert_eq!(Editor::open(&folder.path().join("row.ply")).unwrap().steps().len(), 1);
    }

    #[test]
    fn what_is_selected_gets_a_name_and_is_found_by_it() {
        let folder = tempfile::tempdir().unwrap();
        let (mut session, _) = session(folder.path());
        let name = |name: &str| Order::Name { name: name.to_owned(), class: "gate".to_owned() };
        assert!(session.obey(name("row")).unwrap_err().to_string().contains("nothing is selected"));
        session.obey(left_half(false, false)).unwrap();
        assert!(session.obey(name(" ")).unwrap_err().to_string().contains("give a name"));
        let (said, _) = session.obey(name(" row ")).unwrap();
        assert!(said.starts_with("row (gate): 0.02 x 2.02 x 0.02 m, in "), "{said}");
        assert_eq!(session.report(&[], said).parts, ["row (gate): 0.02 x 2.02 x 0.02 m"]);
        // As a data set reads it, of the scene in the world.
        let parts = PartsFile::read(&parts_path(&folder.path().join("row.ply"))).unwrap();
        let mut splats = session.editor.splats().clone();
        session.placement.apply(&mut splats);
        let found = parts.label(&splats).iter().filter(|part| **part == Some(0)).count();
        assert_eq!(found, 11);
        assert_eq!(session.parts, parts);
    }

    #[test]
    fn what_is_selected_has_a_colour_of_its_own() {
        let folder = tempfile::tempdir().unwrap();
        let (session, _) = session(folder.path());
        let mut splats = session.editor.splats().clone();
        let mut marks = vec![false; splats.len()];
        marks[3] = true;
        highlight(&mut splats, &marks);
        let colour =
            |k: usize| vizflyt_splat::harmonics::colour(&splats.sh[3 * k..][..3], [1.0, 0.0, 0.0]);
        assert!(colour(3)[0] > colour(2)[0] + 0.1 && colour(3)[2] < colour(2)[2] - 0.2);
        assert_eq!(colour(4), colour(2));
    }
}
