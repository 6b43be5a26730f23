//! `vizflyt scene edit --page`: the view, with a lasso and a box to select splats.
//!
//! ```text
//! GET  /edit.js, /edit.css    panel
//! POST /api/edit              Order -> EditState: selection and result
//! ```
//! A selection is an outline in an image, with the camera of that image; the server finds the splats inside and colours
//! them. Deleting adds a step, as on the command line; saving writes the list of steps and the result. Naming writes
//! the box around the selection into the scene's file of parts, at once. Only this server's page, in a browser on this
//! computer, may edit.

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

/// A scene being edited, and the selection.
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

/// Request of the page.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Order {
    /// Returns the state only.
    Report,
    /// Selects the splats of an image within an outline.
    Select(Outline),
    /// Inverts the selection.
    Invert,
    /// Clears the selection.
    Clear,
    /// Removes the selected splats.
    Delete,
    /// Undoes the last step.
    Undo,
    /// Writes the result and the list of steps.
    Save,
    /// Names the selection as a part of the scene.
    Name { name: String, class: String },
}

/// An outline in an image.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Outline {
    /// Request of the image.
    request: Request,
    /// Corners, as fractions of its width and height.
    corners: Vec<[f64; 2]>,
    /// Whether to select only the splats in front.
    visible: bool,
    /// Whether to add to the selection.
    adds: bool,
}

/// State that the page shows.
#[derive(Debug, Serialize)]
struct EditState {
    splats: usize,
    selected: usize,
    /// Descriptions of the steps, in order.
    steps: Vec<String>,
    /// Descriptions of the named parts.
    parts: Vec<String>,
    saved: bool,
    /// Path of the result.
    output: String,
    /// Result of the last request, as text.
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

    /// Executes a request; returns its result as text, and whether the image changes.
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
                ensure!(!self.regions.is_empty(), "nothing is selected; select splats first");
                self.is_inverted ^= true;
                Ok((String::new(), true))
            }
            Order::Clear => {
                let had = !self.regions.is_empty();
                self.clear();
                Ok((String::new(), had))
            }
            Order::Delete => {
                ensure!(!self.regions.is_empty(), "nothing is selected; select splats first");
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
                ensure!(!self.regions.is_empty(), "nothing is selected; select splats first");
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

    /// Returns the region inside an outline, in the frame of the file.
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

    /// Returns for each splat whether it is selected.
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

    /// Returns a renderer of the scene in the world, with the selection coloured.
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

/// Mixes a colour into the marked splats, for all directions.
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

/// Returns the routes of the panel.
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

/// Maximum request; an outline of 2000 corners has 80 kB. [byte]
const MAX_ORDER: usize = 256 << 10;
/// Orange: rare in rooms, and visible in the dark. [linear RGB]
const HIGHLIGHT: [f32; 3] = [1.0, 0.35, 0.0];
/// Share of the highlight; the rest is the splat's own colour.
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

    /// A row of splats along the world's y, 4 m in front of the camera, in a file with another frame.
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

    /// Returns a request as the page sends it, for the left half of the image and slightly more.
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
    fn selects_deletes_undoes_and_saves_an_outline() {
        let folder = tempfile::tempdir().unwrap();
        let (mut session, _) = session(folder.path());
        let count = |session: &Session| session.selected().iter().filter(|mark| **mark).count();
        assert!(session.obey(Order::Delete).is_err() && session.obey(Order::Undo).is_err());
        // Left is +y: ten splats, and the middle one.
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
    fn names_the_selection_as_a_part() {
        let folder = tempfile::tempdir().unwrap();
        let (mut session, _) = session(folder.path());
        let name = |name: &str| Order::Name { name: name.to_owned(), class: "gate".to_owned() };
        assert!(session.obey(name("row")).unwrap_err().to_string().contains("nothing is selected"));
        session.obey(left_half(false, false)).unwrap();
        assert!(session.obey(name(" ")).unwrap_err().to_string().contains("give a name"));
        let (said, _) = session.obey(name(" row ")).unwrap();
        assert!(said.starts_with("row (gate): 0.02 x 2.02 x 0.02 m, in "), "{said}");
        assert_eq!(session.report(&[], said).parts, ["row (gate): 0.02 x 2.02 x 0.02 m"]);
        // As a data set reads it, from the scene in the world.
        let parts = PartsFile::read(&parts_path(&folder.path().join("row.ply"))).unwrap();
        let mut splats = session.editor.splats().clone();
        session.placement.apply(&mut splats);
        let found = parts.label(&splats).iter().filter(|part| **part == Some(0)).count();
        assert_eq!(found, 11);
        assert_eq!(session.parts, parts);
    }

    #[test]
    fn highlights_only_the_selection() {
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
