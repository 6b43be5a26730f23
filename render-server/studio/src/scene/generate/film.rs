//! Rendering of a capture: renders the walk band by band and draws the tags. A second thread develops and stores the
//! images.

use std::sync::mpsc;
use std::time::Instant;

use anyhow::{Result, bail};
use vizflyt_arena::objects::MovingObjects;
use vizflyt_process::print_fmt;
use vizflyt_protocol::geometry::{Cam, Pose, World};
use vizflyt_scenes::film::{BandImage, Exposure, Film, Meter, Phone};
use vizflyt_scenes::{FilmSet, Print};
use vizflyt_splat::{CpuRenderer, Rasterizer, RgbdImage, Scene};
use vizflyt_tags::camera::{Mounting, TagCamera};
use vizflyt_tags::family::TagFamily;
use vizflyt_tags::layout::{LayoutFrame, Square, Tag, TagLayout};
use vizflyt_tags::synth::Renderer;
use vizflyt_tags::synth::ink::Sheets;

use super::GenerateArgs;
use super::sink::{Sink, Target};
use super::truth::{CaptureTruth, ImageTruth};

/// Settings and target of a capture.
pub(super) struct Shoot {
    kind: vizflyt_scenes::SceneKind,
    seed: u64,
    target: Target,
    moving: bool,
    film: Film,
    /// Middle of the exposure of each image's middle row. [s since the start of the walk]
    instants_s: Vec<f64>,
}

/// Rendered image that is not yet developed.
struct Latent {
    number: usize,
    bands: Vec<BandImage>,
    exposure: Exposure,
}

impl Shoot {
    /// Returns the settings for a command line.
    ///
    /// # Errors
    /// The image size is invalid, or the walk is too short for the number of images.
    pub(super) fn of(args: &GenerateArgs, target: Target) -> Result<Self> {
        let (width, height) = (args.size.width_px, args.size.height_px);
        let sides = SIDES_PX;
        if !sides.contains(&width) || !sides.contains(&height) {
            bail!("--size {width}x{height}: give sides of {} to {} px", sides.start(), sides.end());
        }
        if matches!(target, Target::Video(_)) && (width % 2, height % 2) != (0, 0) {
            bail!("--size {width}x{height}: a video needs even sides");
        }
        let instants_s = instants_s(&target, args.seconds, args.frames)?;
        let film = Film::new(Phone::draw(args.kind, args.seed, width, height));
        Ok(Self { kind: args.kind, seed: args.seed, target, moving: args.moving, film, instants_s })
    }

    /// Renders the walk and writes all files.
    ///
    /// # Errors
    /// An image cannot be rendered, encoded or written.
    pub(super) fn run(self, set: &FilmSet) -> Result<()> {
        let phone = *self.film.phone();
        let layout = layout(&set.prints);
        let track = |at_s: f64| set.walk.world_from_cam(at_s);
        let k = &phone.intrinsics;
        let mut sink = Sink::open(&self.target, [k.width_px, k.height_px], RATE_HZ)?;
        let start = Instant::now();
        let (latents, to_develop) = mpsc::sync_channel::<Latent>(2);
        let images = std::thread::scope(|scope| -> Result<Vec<ImageTruth>> {
            let (film, instants_s, seed) = (&self.film, &self.instants_s, self.seed);
            let developer = scope.spawn(move || -> Result<()> {
                for Latent { number, bands, exposure } in to_develop {
                    let noise = seed ^ (number as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
                    let rgb = film.develop(&bands, &track, instants_s[number], &exposure, noise);
                    sink.write(number, &rgb)?;
                }
                sink.finish()
            });
            // If the developer fails, rendering stops, and the developer's error is returned.
            let rendered = self.render(set, layout.as_ref(), &track, &latents);
            drop(latents);
            let developed = developer.join().expect("the developer does not panic");
            developed.and(rendered)
        })?;
        let count = images.len();
        let truth = CaptureTruth::new(&self, &phone, images, layout.as_ref());
        truth.write(&self.target.truth_file())?;
        camera_file(&phone).write(&self.target.camera_file())?;
        print_fmt!(
            "capture     {count} images in {:.0} s: {}",
            start.elapsed().as_secs_f64(),
            self.target
        );
        print_fmt!("truth       {}", self.target.truth_file().display());
        print_fmt!("lens        {}", self.target.camera_file().display());
        if let Some(layout) = layout {
            layout.write(&self.target.tags_file())?;
            print_fmt!("tags        {}", self.target.tags_file().display());
        }
        Ok(())
    }

    /// Renders each image and sends it to the developer. Stops early if the receiver is closed.
    fn render(
        &self,
        set: &FilmSet,
        layout: Option<&TagLayout>,
        track: &(dyn Fn(f64) -> Pose<World, Cam> + Sync),
        latents: &mpsc::SyncSender<Latent>,
    ) -> Result<Vec<ImageTruth>> {
        let FilmSet { scene, .. } = set;
        // CPU renderer in full detail, so that all machines produce the same images.
        let mut renderer =
            CpuRenderer::new(Scene { splats: &scene.splats, objects: &scene.objects });
        let movers = MovingObjects::new(&scene.arena, self.seed);
        let bands = self.film.bands();
        let inks: Vec<Renderer> = match layout {
            Some(_) => bands.iter().map(|band| Renderer::new(band.intrinsics)).collect(),
            None => Vec::new(),
        };
        let mut meter = Meter::default();
        let mut rendered = [RgbdImage::default()];
        let mut images = Vec::with_capacity(self.instants_s.len());
        let start = Instant::now();
        let mut told = 0;
        let mut last_s = self.instants_s[0];
        for (number, &middle_s) in self.instants_s.iter().enumerate() {
            let mut seen = Vec::with_capacity(bands.len());
            for (n, band) in bands.iter().enumerate() {
                let camera = self.film.camera(band, track, middle_s);
                let at_s = if self.moving { self.film.instant_s(band, middle_s) } else { 0.0 };
                let placements = movers.placements((at_s * 1e9).round() as i64);
                renderer.render(&placements, &[camera], &mut rendered)?;
                let mut image = BandImage::default();
                self.film.take(&camera, &rendered[0], &mut image);
                if let Some(layout) = layout {
                    let BandImage { world_from_cam, light, depth_m } = &mut image;
                    let world_from_cam = *world_from_cam;
                    inks[n].ink(layout, Sheets { light, depth_m, world_from_cam }, OPTICS_PX);
                }
                seen.push(image);
            }
            let exposure = meter.next(self.film.phone(), bands, &seen, middle_s - last_s);
            last_s = middle_s;
            let file = self.target.image_name(number);
            images.push(ImageTruth::new(&self.film, track, middle_s, &exposure, file));
            if latents.send(Latent { number, bands: seen, exposure }).is_err() {
                break;
            }
            let tenth = 10 * (number + 1) / self.instants_s.len();
            if tenth > told && self.instants_s.len() > 100 {
                told = tenth;
                let done = (number + 1) as f64 / self.instants_s.len() as f64;
                let left_s = start.elapsed().as_secs_f64() * (1.0 - done) / done;
                print_fmt!("filming     {:.0} %, {left_s:.0} s left", 100.0 * done);
            }
        }
        Ok(images)
    }

    pub(super) fn kind(&self) -> vizflyt_scenes::SceneKind {
        self.kind
    }

    pub(super) fn seed(&self) -> u64 {
        self.seed
    }

    /// Returns whether moving objects are animated.
    pub(super) fn moving(&self) -> bool {
        self.moving
    }

    /// Returns the frame rate of a video. [Hz]
    pub(super) fn rate_hz(&self) -> Option<f64> {
        matches!(self.target, Target::Video(_)).then_some(f64::from(RATE_HZ))
    }
}

/// Returns the times of the images.
fn instants_s(target: &Target, seconds: f64, frames: Option<u32>) -> Result<Vec<f64>> {
    if frames == Some(0) {
        bail!("--frames 0: give at least 1");
    }
    match target {
        Target::Video(_) => {
            let all = (seconds * f64::from(RATE_HZ)).round() as u32;
            let count = frames.unwrap_or(all);
            if count > all {
                bail!("--frames {count}: {seconds} s are {all} images; give more --seconds");
            }
            Ok((0..count).map(|n| f64::from(n) / f64::from(RATE_HZ)).collect())
        }
        Target::Folder(_) => {
            let count = frames.unwrap_or(FOLDER_IMAGES);
            let rate_hz = f64::from(count) / seconds;
            if rate_hz > MOST_HZ {
                bail!(
                    "--frames {count}: more than {MOST_HZ} a second of {seconds} s; give more --seconds"
                );
            }
            Ok((0..count).map(|n| f64::from(n) / rate_hz).collect())
        }
    }
}

/// Returns the tags of the boards; `None` without boards.
fn layout(prints: &[Print]) -> Option<TagLayout> {
    let tag = |(print, id): (&Print, u32)| {
        let pose = print.world_from_print;
        let world_from_tag: Pose<World, Square> = Pose::new(pose.translation_m, pose.rotation);
        // The tag is ten cells wide, of which the black square has eight, plus a rim.
        let size_m = TAG_SHARE * print.side_m;
        Tag::new(TagFamily::Tag36h11, id, (size_m * 1e3).round() / 1e3, world_from_tag)
    };
    let tags: Vec<Tag> = prints.iter().zip(0..).map(tag).collect();
    (!tags.is_empty()).then_some(TagLayout { frame: LayoutFrame::World, tags })
}

/// Returns the phone's lens in the format of `vizflyt tags calibrate`.
fn camera_file(phone: &Phone) -> TagCamera {
    TagCamera {
        name: "phone".into(),
        source: None,
        intrinsics: phone.intrinsics,
        mounting: Mounting::Unknown,
        calibration: None,
        survey: None,
        latency_ms: 0.0,
    }
}

/// Frame rate of a video, as phones use it. [Hz]
const RATE_HZ: u32 = 30;
/// Default number of images in a folder.
const FOLDER_IMAGES: u32 = 80;
/// Maximum image rate in a folder, because exposures must not overlap. [Hz]
const MOST_HZ: f64 = 30.0;
/// Standard deviation of the blur of drawn tags. With the pixel's area and the interpolation of rows, the total is
/// about 0.6 px, as in a phone's video. [px]
const OPTICS_PX: f64 = 0.3;
/// Edge of a tag's black square relative to the edge of its board: 0.24 m of 0.38 m.
const TAG_SHARE: f64 = 0.24 / 0.38;
/// Allowed image sides: tags are not visible in smaller images, and larger ones take hours. [px]
const SIDES_PX: std::ops::RangeInclusive<u32> = 64..=3840;
