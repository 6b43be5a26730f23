//! Datasets: photos with poses, and points, as the input of a training.
//!
//! A folder has nerfstudio's format (`transforms.json`) or COLMAP's (`sparse/0`, `images`). The model is read first;
//! then every photo once, several in parallel: undistorted, reduced, and kept as bytes. The total memory is computed
//! and limited before the first photo is opened.

pub mod colmap;
mod error;
pub mod nerfstudio;
mod photo;
pub mod point_cloud;
mod sparse;

use std::path::{Path, PathBuf};

use glam::{DVec2, Vec3};
use rayon::prelude::*;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use self::error::read_file;
use self::photo::Rgba;
use crate::loss::{SeenPoint, Target};
use crate::view::View;

pub use error::DatasetError;
pub use sparse::{SparseImage, SparseModel, SparsePoint, SparseSighting};

/// A capture with known poses. All lengths are in units of the dataset, in its own frame.
#[derive(Clone, Debug, Default)]
pub struct Dataset {
    /// Photos in the order of their names; at least two if read from files.
    pub photos: Vec<Photo>,
    /// Points of structure from motion; may be empty.
    pub points: Vec<Point>,
    /// Names of photos with a pose but without a file, as in thinned public datasets. At most half of all.
    pub absent: Vec<String>,
}

/// A photo, undistorted.
#[derive(Clone, Debug)]
pub struct Photo {
    /// File name, relative to the dataset.
    pub name: String,
    /// Camera and pose.
    pub view: View,
    /// Pixels and known depths.
    pub target: Target,
}

/// A point of structure from motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    pub position: Vec3,
    /// sRGB.
    pub rgb: [u8; 3],
}

impl Dataset {
    /// Returns 1.1 times the largest distance of a camera from the cameras' centroid. Trainers scale lengths by it.
    /// Returns 1 if all cameras are in one place.
    pub fn extent(&self) -> f32 {
        let positions = || self.photos.iter().map(|photo| photo.view.position);
        let middle = positions().sum::<Vec3>() / self.photos.len().max(1) as f32;
        let reach = positions().map(|p| p.distance(middle)).fold(0.0, f32::max) * 1.1;
        if reach > 1e-6 { reach } else { 1.0 }
    }
}

/// Name and pose of a photo.
pub type PhotoPose = (String, Pose<World, Cam>);

/// Returns the names and poses of a folder's photos, in the order of their names, without opening any photo.
///
/// # Errors
/// As in [`Dataset::read`], for the poses.
pub fn read_poses(folder: &Path) -> Result<Vec<PhotoPose>, DatasetError> {
    let (plans, _) = of_folder(folder)?;
    let mut poses: Vec<_> =
        plans.into_iter().map(|plan| (plan.name, plan.world_from_cam)).collect();
    poses.sort_by(|a, b| a.0.cmp(&b.0));
    Ok(poses)
}

fn of_folder(folder: &Path) -> Result<(Vec<Plan>, Points), DatasetError> {
    let transforms = folder.join("transforms.json");
    if transforms.is_file() {
        of_nerfstudio(folder, &transforms)
    } else if let Some(model) = colmap::find(folder) {
        of_colmap(folder, &model)
    } else {
        Err(DatasetError::NotADataset(folder.to_owned()))
    }
}

impl Dataset {
    /// Reads a folder. Photos are reduced to at most `width_px`.
    ///
    /// # Errors
    /// [`DatasetError`], which names the file and the remedy.
    pub fn read(folder: &Path, width_px: Option<u32>) -> Result<Self, DatasetError> {
        let (plans, points) = of_folder(folder)?;
        Self::of_plans(folder, &plans, points, width_px)
    }

    /// Reads the photos of a known model; its image names are relative to the folder `images`. Photos are reduced to at
    /// most `width_px`.
    ///
    /// # Errors
    /// [`DatasetError`], which names the photo and the remedy.
    pub fn of_model(
        model: &SparseModel,
        images: &Path,
        width_px: Option<u32>,
    ) -> Result<Self, DatasetError> {
        let (plans, points) = plans(model, images, None);
        Self::of_plans(images, &plans, points, width_px)
    }

    fn of_plans(
        folder: &Path,
        plans: &[Plan],
        points: Points,
        width_px: Option<u32>,
    ) -> Result<Self, DatasetError> {
        let (plans, absent): (Vec<&Plan>, Vec<&Plan>) =
            plans.iter().partition(|plan| plan.image.exists());
        if absent.len() > plans.len() {
            return Err(DatasetError::Absent {
                first: absent[0].image.clone(),
                absent: absent.len(),
                images: absent.len() + plans.len(),
            });
        }
        if plans.len() < 2 {
            return Err(DatasetError::TooFew(folder.to_owned(), plans.len()));
        }
        check_memory(&plans, width_px)?;
        let absent = absent.iter().map(|plan| plan.name.clone()).collect();
        let mut photos = plans
            .par_iter()
            .map(|plan| plan.load(width_px, &points))
            .collect::<Result<Vec<_>, _>>()?;
        photos.sort_by(|a, b| a.name.cmp(&b.name));
        let points = points.into_values().collect();
        let mut dataset = Self { photos, points, absent };
        let near = NEAR * dataset.extent();
        for photo in &mut dataset.photos {
            photo.view.near = near;
        }
        Ok(dataset)
    }
}

/// A photo that has not been read yet.
struct Plan {
    name: String,
    image: PathBuf,
    mask: Option<PathBuf>,
    /// 16-bit PNG and the size of its step.
    depth: Option<(PathBuf, f32)>,
    /// `Err` is a horizontal field of view; the intrinsics follow from it and the image's size.
    intrinsics: Result<Intrinsics, f64>,
    world_from_cam: Pose<World, Cam>,
    /// Ids of the points visible in the photo, for depth.
    seen: Vec<u64>,
}

type Points = std::collections::BTreeMap<u64, Point>;

fn of_colmap(folder: &Path, model: &Path) -> Result<(Vec<Plan>, Points), DatasetError> {
    let sparse = colmap::read(model)?;
    // Folders of images, also for a model without its dataset.
    let images = [folder.join("images"), model.join("images"), folder.to_owned()];
    let images = images.iter().find(|path| path.is_dir()).unwrap_or(&images[0]);
    Ok(plans(&sparse, images, Some(&folder.join("masks"))))
}

/// Returns the photos of a model, not read yet, and its points.
fn plans(sparse: &SparseModel, images: &Path, masks: Option<&Path>) -> (Vec<Plan>, Points) {
    let well_seen = |id: &u64| sparse.points.get(id).is_some_and(|p| p.track >= WELL_SEEN);
    let plans = sparse.images.iter().map(|image| {
        let mask = masks.map(|masks| masks.join(format!("{}.png", image.name)));
        Plan {
            name: image.name.clone(),
            image: images.join(&image.name),
            mask: mask.filter(|mask| mask.is_file()),
            depth: None,
            intrinsics: Ok(image.intrinsics),
            world_from_cam: image.world_from_cam,
            seen: image.seen.iter().map(|seen| seen.point).filter(well_seen).collect(),
        }
    });
    let points = sparse
        .points
        .iter()
        .map(|(&id, point)| (id, Point { position: point.position.as_vec3(), rgb: point.rgb }));
    (plans.collect(), points.collect())
}

fn of_nerfstudio(folder: &Path, file: &Path) -> Result<(Vec<Plan>, Points), DatasetError> {
    let bytes = read_file(file)?;
    let damaged = |what: String| DatasetError::damaged(file, what);
    let text = String::from_utf8(bytes).map_err(|_| damaged("not text in UTF-8".to_owned()))?;
    let transforms = nerfstudio::parse(&text).map_err(|error| match error {
        nerfstudio::TransformsError::Damaged(what) => damaged(what),
        nerfstudio::TransformsError::Lens(model) => {
            DatasetError::Lens { path: file.to_owned(), model }
        }
    })?;
    let plans = transforms.frames.into_iter().map(|frame| {
        let mut image = folder.join(&frame.file);
        if image.extension().is_none() {
            image.set_extension("png");
        }
        Plan {
            name: frame.file,
            image,
            mask: frame.mask.map(|mask| folder.join(mask)),
            depth: frame.depth.map(|depth| (folder.join(depth), frame.depth_step)),
            intrinsics: frame.intrinsics,
            world_from_cam: frame.world_from_cam,
            seen: Vec::new(),
        }
    });
    let mut points = Points::new();
    if let Some(name) = transforms.points {
        let path = folder.join(name);
        let cloud = point_cloud::parse(&read_file(&path)?)
            .map_err(|what| DatasetError::damaged(&path, what))?;
        for (id, (position, rgb)) in (0..).zip(cloud) {
            points.insert(id, Point { position: position.as_vec3(), rgb });
        }
    }
    Ok((plans.collect(), points))
}

/// Checks that all photos fit into the memory limit.
fn check_memory(plans: &[&Plan], width_px: Option<u32>) -> Result<(), DatasetError> {
    let bytes = |plan: &&Plan| {
        // If the size is unknown before the image is read, the width bounds it.
        let side = u64::from(width_px.unwrap_or(1920));
        let pixels = plan
            .intrinsics
            .as_ref()
            .map_or(side * side, |k| photo::pinhole(k, width_px).pixels() as u64);
        pixels * if plan.depth.is_some() { 8 } else { 4 }
    };
    let needed: u64 = plans.iter().map(bytes).sum();
    if needed > MAX_BYTES {
        let (megabytes, limit) = (needed >> 20, MAX_BYTES >> 20);
        return Err(DatasetError::TooLarge { images: plans.len(), megabytes, limit });
    }
    Ok(())
}

impl Plan {
    fn load(&self, width_px: Option<u32>, points: &Points) -> Result<Photo, DatasetError> {
        let mut image = photo::read(&self.image)?;
        let size = (image.width, image.height);
        let given = match self.intrinsics {
            Ok(k) => k,
            Err(angle) => {
                let k = Intrinsics::from_horizontal_fov(size.0, size.1, angle);
                k.validate().map_err(|e| DatasetError::damaged(&self.image, e.to_string()))?;
                k
            }
        };
        let shape = |path: &Path, found| DatasetError::Shape {
            path: path.to_owned(),
            found,
            expected: (given.width_px, given.height_px),
        };
        let camera = photo::fitted(&given, size).ok_or_else(|| shape(&self.image, size))?;
        if let Some(path) = &self.mask {
            apply_mask(&mut image, &photo::read(path)?).map_err(|found| shape(path, found))?;
        }
        // From the model's camera: photos and depth images of other sizes get the same size.
        let pinhole = photo::pinhole(&given, width_px.map(|w| w.min(camera.width_px)));
        let seen = photo::undistort(&image, &camera, &pinhole);
        let view = View::new(&pinhole, &self.world_from_cam, 0.0);
        let mask: Vec<u8> = seen.pixels.iter().map(|p| p[3]).collect();
        let mut target = Target {
            width: view.width,
            height: view.height,
            rgb: seen.pixels.iter().flat_map(|p| [p[0], p[1], p[2]]).collect(),
            mask: if mask.iter().all(|&m| m > 0) { Vec::new() } else { mask },
            ..Target::default()
        };
        for id in &self.seen {
            if let Some(([x, y], z)) = points.get(id).and_then(|p| view.project(p.position)) {
                let inside =
                    x >= 0.0 && y >= 0.0 && x < view.width as f32 && y < view.height as f32;
                if inside && z.is_finite() {
                    let pixel = (y as usize * view.width + x as usize) as u32;
                    target.points.push(SeenPoint { pixel, z });
                }
            }
        }
        if let Some((path, step)) = &self.depth {
            let (width, height, depth) = photo::read_depth(path)?;
            let k = photo::fitted(&given, (width, height))
                .ok_or_else(|| shape(path, (width, height)))?;
            target.depth = undistorted_depth(&depth, &k, &pinhole, *step);
        }
        Ok(Photo { name: self.name.clone(), view, target })
    }
}

/// Removes the pixels that are black in a mask. `Err` is the mask's size if its aspect ratio differs.
fn apply_mask(image: &mut Rgba, mask: &Rgba) -> Result<(), (u32, u32)> {
    let (width, height) = (image.width as usize, image.height as usize);
    let (w, h) = (mask.width as usize, mask.height as usize);
    if width.abs_diff(w * height / h) > 2 + width / h {
        return Err((mask.width, mask.height));
    }
    for (i, pixel) in image.pixels.iter_mut().enumerate() {
        let (x, y) = (i % width * w / width, i / width * h / height);
        if mask.pixels[y * w + x][..3] == [0; 3] {
            pixel[3] = 0;
        }
    }
    Ok(())
}

/// Returns depths in the pinhole's pixels, by nearest neighbour: interpolation between two surfaces would be wrong.
fn undistorted_depth(depth: &[u16], k: &Intrinsics, pinhole: &Intrinsics, step: f32) -> Vec<f32> {
    let place = photo::Resampler::new(k, pinhole);
    let pixels = (0..pinhole.height_px).flat_map(|y| (0..pinhole.width_px).map(move |x| (x, y)));
    let at = |(x, y): (u32, u32)| {
        let at = place.at(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5))?;
        let inside = at.x >= 0.0 && at.y >= 0.0;
        let (u, v) = (at.x as u32, at.y as u32);
        let inside = inside && u < k.width_px && v < k.height_px;
        inside.then(|| f32::from(depth[(v * k.width_px + u) as usize]) * step)
    };
    pixels.map(|pixel| at(pixel).unwrap_or(0.0)).collect()
}

/// Near limit: closer points are not rendered. [extents of the capture]
const NEAR: f32 = 0.01;
/// Minimum number of images that see a point whose depth is used.
const WELL_SEEN: usize = 3;
/// Maximum memory of all photos. [bytes]
const MAX_BYTES: u64 = 4 << 30;
