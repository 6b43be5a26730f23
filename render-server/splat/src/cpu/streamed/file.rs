//! File format of packed scenes, from which single blocks can be read, and its tables in memory.
//!
//! ```text
//! header    48 bytes: magic, version, parts, blocks, splats, allowed error, anti-aliasing, checksum
//! blocks    part by part, level by level: geometry, then harmonics, in the layout of `scene::Part`
//! parts     8 bytes each: blocks of the finest level, degree of the harmonics
//! blocks    36 bytes each: bounds, error, checksum of the block's bytes
//! ```
//! All numbers are little-endian. The number of blocks of the finest level determines the numbers of the coarser
//! ones, and so the position of every block in the file: the file contains no offsets. The tables are at the end, so
//! that a scene is written in one pass, part by part. Checksums (CRC-32 of ISO 3309) detect damage, not manipulation.
//! For untrusted files, all values are also validated against the renderer's limits.

use std::fs::File;
use std::io::{self, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use flate2::Crc;
use glam::Vec3;

use super::super::detail::{BRANCH, Detail};
use super::super::scene::{BLOCK, Block, GROUP, GROUP_NUMBERS, Part, column};
use crate::Splats;
use crate::format::{self, FormatError};

/// Magic number: the first bytes of the file.
pub(crate) const MAGIC: &[u8; 8] = b"VFPACKED";
const VERSION: u32 = 1;
/// Header size. [byte]
const HEADER: usize = 48;
/// Header bytes that the checksum covers, before the tables. [byte]
const CHECKED: usize = 40;
/// Size of a part in its table. [byte]
const PART: usize = 8;
/// Size of a block in its table. [byte]
const ROW: usize = 36;
/// Number of values of a block's geometry.
pub(super) const GEOMETRY: usize = BLOCK / GROUP * GROUP_NUMBERS;
/// Maximum degree of the harmonics.
const MAX_DEGREE: u32 = 3;

/// Input of a packed scene: a file, or bytes in memory.
pub trait Source: Read + Seek + Send {}

impl<T: Read + Seek + Send> Source for T {}

/// Why a scene cannot be packed, or a packed scene cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PackedError {
    /// I/O error of the operating system.
    #[error("cannot {verb} {}: {cause}", path.display())]
    Io {
        /// Path of the file.
        path: PathBuf,
        /// `read` or `write`.
        verb: &'static str,
        /// Error of the operating system.
        cause: io::Error,
    },
    /// File is truncated, damaged, or not a packed scene.
    #[error("packed scene, {place}: {reason}")]
    Invalid {
        /// Invalid section of the file.
        place: String,
        /// Reason.
        reason: String,
    },
    /// Scene to pack is invalid.
    #[error(transparent)]
    Scene(#[from] FormatError),
    /// Reader thread cannot be started.
    #[error("cannot start the thread that reads the scene: {0}")]
    Thread(io::Error),
    /// Box contains more splats than allowed in memory.
    #[error("more than {most} splats lie between {min_m} and {max_m} m")]
    Crowded {
        /// Maximum number of splats.
        most: usize,
        /// Minimum corner of the box. [m]
        min_m: Vec3,
        /// Maximum corner of the box. [m]
        max_m: Vec3,
    },
    /// Memory is less than the coarsest blocks of all parts need.
    #[error("{given} bytes of memory are too few for this scene; it needs {least} at least")]
    Memory {
        /// Available memory. [byte]
        given: usize,
        /// Minimum memory. [byte]
        least: usize,
    },
}

fn invalid(place: impl Into<String>, reason: impl Into<String>) -> PackedError {
    PackedError::Invalid { place: place.into(), reason: reason.into() }
}

/// Levels of one part of the scene: a tree of blocks, as [`super::super::detail`] builds it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tree {
    /// Index of its first block among all blocks.
    pub(super) first: usize,
    /// First block of each level, relative to `first`; then the end of the last level.
    pub(super) levels: Vec<usize>,
    coefficients: usize,
    /// Offset of its blocks in the file. [byte]
    at: u64,
}

impl Tree {
    fn new(first: usize, finest: usize, coefficients: usize, at: u64) -> Self {
        let (mut levels, mut size) = (vec![0, finest], finest);
        while size > 1 {
            size = size.div_ceil(BRANCH);
            levels.push(levels[levels.len() - 1] + size);
        }
        Self { first, levels, coefficients, at }
    }

    /// Returns the number of blocks.
    fn len(&self) -> usize {
        self.levels[self.levels.len() - 1]
    }

    /// Returns the index, among all blocks, of the block that represents the whole part.
    pub(super) fn top(&self) -> usize {
        self.first + self.len() - 1
    }

    fn block_bytes(&self) -> usize {
        block_bytes(self.coefficients)
    }
}

/// Returns the size of a block with `coefficients` coefficients per colour. [byte]
pub(super) fn block_bytes(coefficients: usize) -> usize {
    GEOMETRY * 4 + coefficients * 3 * BLOCK * 2
}

/// Opened packed scene, with the bounds of all its blocks: about 40 bytes per 256 splats.
pub struct PackedScene {
    pub(super) trees: Vec<Tree>,
    /// Blocks of all parts.
    pub(super) blocks: Vec<Block>,
    checks: Vec<u32>,
    /// Maximum number of coefficients per colour of all parts.
    pub(super) coefficients: usize,
    pub(super) antialiased: bool,
    pub(super) max_error_px: f32,
    pub(super) splats: usize,
    source: Box<dyn Source>,
    bytes: Vec<u8>,
}

impl std::fmt::Debug for PackedScene {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PackedScene({} parts, {} splats)", self.trees.len(), self.splats)
    }
}

impl PackedScene {
    /// Returns whether a file starts with the magic number of a packed scene.
    pub fn is_packed(path: impl AsRef<Path>) -> bool {
        let path = path.as_ref();
        let mut start = [0; MAGIC.len()];
        // Checked before opening: opening a pipe would block until it has a writer.
        path.is_file()
            && File::open(path).and_then(|mut file| file.read_exact(&mut start)).is_ok()
            && start == *MAGIC
    }

    /// Opens a packed scene.
    ///
    /// # Errors
    /// If the file cannot be read, is truncated or damaged, or is not a packed scene.
    pub fn open(path: impl AsRef<Path>) -> Result<Self, PackedError> {
        let path = path.as_ref();
        let file = File::open(path).map_err(|cause| read_error(path, cause))?;
        Self::from_source(Box::new(file))
    }

    /// Opens a packed scene from any source.
    ///
    /// # Errors
    /// Same as [`Self::open`].
    pub fn from_source(mut source: Box<dyn Source>) -> Result<Self, PackedError> {
        let io = |cause| read_error(Path::new("the packed scene"), cause);
        let len = source.seek(SeekFrom::End(0)).map_err(io)?;
        if len < HEADER as u64 {
            return Err(invalid("header", format!("the file has only {len} bytes")));
        }
        source.rewind().map_err(io)?;
        let mut header = [0; HEADER];
        source.read_exact(&mut header).map_err(io)?;
        if !header.starts_with(MAGIC) {
            return Err(invalid(
                "header",
                "this is not a packed scene; `vizflyt scene pack` makes one",
            ));
        }
        let mut fields = Fields(&header[MAGIC.len()..]);
        let (version, parts) = (fields.u32(), fields.u32() as u64);
        let (blocks, splats) = (fields.u64(), fields.u64());
        let (max_error_px, antialiased, check) = (fields.f32(), fields.u32(), fields.u32());
        if version != VERSION {
            return Err(invalid("header", format!("version {version}; this reads {VERSION}")));
        }
        if !(max_error_px > 0.0 && max_error_px.is_finite()) || antialiased > 1 {
            return Err(invalid("header", "numbers that no packing writes"));
        }
        // Every part has a block, and every block is larger than its row: reject files that are too small for their
        // counts.
        let tables =
            parts.saturating_mul(PART as u64).saturating_add(blocks.saturating_mul(ROW as u64));
        if parts == 0
            || blocks < parts
            || blocks >= u64::from(u32::MAX)
            || tables > len - HEADER as u64
        {
            return Err(invalid(
                "header",
                format!(
                    "{parts} parts of {blocks} blocks, and {len} bytes; the file is cut or damaged"
                ),
            ));
        }
        let mut rows = vec![0; tables as usize];
        source.seek(SeekFrom::Start(len - tables)).map_err(io)?;
        source.read_exact(&mut rows).map_err(io)?;
        if checksum(&[&header[..CHECKED], &rows]) != check {
            return Err(invalid("tables", "the checksum differs; the file is cut or damaged"));
        }
        let mut fields = Fields(&rows);
        let (trees, data) = read_trees(&mut fields, parts as usize, blocks as usize)?;
        if HEADER as u64 + data + tables != len || splats > blocks * BLOCK as u64 {
            return Err(invalid("tables", format!("they do not belong to a file of {len} bytes")));
        }
        let mut scene = Self {
            coefficients: trees.iter().map(|tree| tree.coefficients).max().unwrap_or(1),
            trees,
            blocks: Vec::with_capacity(blocks as usize),
            checks: Vec::with_capacity(blocks as usize),
            antialiased: antialiased == 1,
            max_error_px,
            splats: splats as usize,
            source,
            bytes: Vec::new(),
        };
        for block in 0..blocks as usize {
            scene.blocks.push(read_row(block, &mut fields)?);
            scene.checks.push(fields.u32());
        }
        Ok(scene)
    }

    /// Returns the number of visible splats.
    pub fn len(&self) -> usize {
        self.splats
    }

    /// Whether the scene has no splats.
    pub fn is_empty(&self) -> bool {
        self.splats == 0
    }

    /// Returns the number of parts.
    pub fn parts(&self) -> usize {
        self.trees.len()
    }

    /// Returns the allowed error of splats for which the scene was packed. [px]
    pub fn max_error_px(&self) -> f32 {
        self.max_error_px
    }

    /// Reads a block into `geometry` and `sh`, in the layout of [`Part`]. Harmonics that its part lacks are set to 0.
    pub(super) fn read(
        &mut self,
        block: usize,
        geometry: &mut [f32],
        sh: &mut [u16],
    ) -> Result<(), PackedError> {
        let place = || format!("block {block}");
        let tree = &self.trees[self.trees.partition_point(|tree| tree.first <= block) - 1];
        let at = tree.at + ((block - tree.first) * tree.block_bytes()) as u64;
        self.bytes.resize(tree.block_bytes(), 0);
        self.source
            .seek(SeekFrom::Start(at))
            .and_then(|_| self.source.read_exact(&mut self.bytes))
            .map_err(|cause| invalid(place(), format!("cannot be read: {cause}")))?;
        if checksum(&[&self.bytes]) != self.checks[block] {
            return Err(invalid(place(), "the checksum differs; the file is damaged"));
        }
        let (floats, halves) = self.bytes.split_at(GEOMETRY * 4);
        for (number, bytes) in geometry.iter_mut().zip(floats.as_chunks().0) {
            *number = f32::from_le_bytes(*bytes);
        }
        let mut levels =
            geometry.chunks_exact(GROUP_NUMBERS).flat_map(|group| &group[column::LEVEL * GROUP..]);
        if levels.any(|level| *level > 0.0) {
            return Err(invalid(place(), "an opacity is above 1"));
        }
        let own = tree.coefficients * 3 * GROUP;
        let padded = self.coefficients * 3 * GROUP;
        for (sh, halves) in sh.chunks_exact_mut(padded).zip(halves.chunks_exact(own * 2)) {
            for (half, bytes) in sh.iter_mut().zip(halves.as_chunks().0) {
                *half = u16::from_le_bytes(*bytes);
            }
            sh[own..].fill(0);
        }
        Ok(())
    }
}

/// Reads the table of parts. Returns the parts and the size of their blocks in bytes.
fn read_trees(
    fields: &mut Fields<'_>,
    parts: usize,
    blocks: usize,
) -> Result<(Vec<Tree>, u64), PackedError> {
    let mut trees = Vec::with_capacity(parts);
    let (mut first, mut data) = (0, 0);
    for part in 0..parts {
        let (finest, degree) = (fields.u32() as usize, fields.u32());
        if finest == 0 || finest > blocks - first || degree > MAX_DEGREE {
            return Err(invalid(
                format!("part {part}"),
                format!("{finest} blocks of degree {degree}"),
            ));
        }
        let coefficients = (degree as usize + 1).pow(2);
        let tree = Tree::new(first, finest, coefficients, HEADER as u64 + data);
        first += tree.len();
        data += tree.len() as u64 * tree.block_bytes() as u64;
        if first > blocks {
            break;
        }
        trees.push(tree);
    }
    if first != blocks {
        return Err(invalid("tables", format!("{parts} parts of {first} blocks, not {blocks}")));
    }
    Ok((trees, data))
}

fn read_row(block: usize, fields: &mut Fields<'_>) -> Result<Block, PackedError> {
    let row = Block {
        center_m: fields.vec3(),
        half_m: fields.vec3(),
        reach_m: fields.f32(),
        error_m: fields.f32(),
    };
    // Bounds that are not finite keep a block in view. A NaN error would select it over its finer level.
    if row.error_m.is_nan() {
        return Err(invalid(format!("block {block}"), "its error is not a number"));
    }
    Ok(row)
}

/// Reader of little-endian numbers. The caller checks the length in advance.
struct Fields<'a>(&'a [u8]);

impl Fields<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let (front, rest) =
            self.0.split_first_chunk().expect("tables are as long as they are read");
        self.0 = rest;
        *front
    }

    fn u32(&mut self) -> u32 {
        u32::from_le_bytes(self.take())
    }

    fn u64(&mut self) -> u64 {
        u64::from_le_bytes(self.take())
    }

    fn f32(&mut self) -> f32 {
        f32::from_le_bytes(self.take())
    }

    fn vec3(&mut self) -> Vec3 {
        Vec3::new(self.f32(), self.f32(), self.f32())
    }
}

fn checksum(pieces: &[&[u8]]) -> u32 {
    let mut crc = Crc::new();
    for piece in pieces {
        crc.update(piece);
    }
    crc.sum()
}

fn read_error(path: &Path, cause: io::Error) -> PackedError {
    PackedError::Io { path: path.to_owned(), verb: "read", cause }
}

/// Statistics of a packing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PackSummary {
    /// Parts, each with its own tree.
    pub parts: usize,
    /// Visible splats.
    pub splats: usize,
    /// Blocks of all levels.
    pub blocks: usize,
}

/// Packs a scene file of any format. A streamed scene is packed chunk by chunk, so that memory depends on the largest
/// chunk. Coarser levels are made for errors of `max_error_px` ([`Detail::Adaptive`]). `place` may move or remove
/// splats of a chunk; `report` is called for every chunk.
///
/// # Errors
/// If the scene cannot be read, the file cannot be written, or only some chunks are trained with anti-aliasing.
pub fn pack(
    from: &Path,
    to: &Path,
    max_error_px: f32,
    place: impl Fn(&mut Splats),
    mut report: impl FnMut(&PackSummary),
) -> Result<PackSummary, PackedError> {
    let io = |cause| PackedError::Io { path: to.to_owned(), verb: "write", cause };
    let mut partial = to.as_os_str().to_owned();
    partial.push(".part");
    let file = File::create(&partial).map_err(io)?;
    let mut packer = Packer::new(BufWriter::new(file), max_error_px).map_err(io)?;
    let packed = format::read_in_chunks(from, |mut splats| {
        place(&mut splats);
        packer.add(&splats).map_err(|error| match error {
            AddError::Io(cause) => io(cause),
            AddError::Mixed => invalid(
                format!("part {}", packer.parts.len()),
                "trained with anti-aliasing, and others without, or the other way round",
            ),
        })?;
        report(&packer.summary);
        Ok(())
    })
    .and_then(|()| packer.finish().map_err(io));
    match packed {
        Ok(summary) => {
            std::fs::rename(&partial, to).map_err(io)?;
            Ok(summary)
        }
        Err(error) => {
            // An incomplete file is useless.
            let _ = std::fs::remove_file(&partial);
            Err(error)
        }
    }
}

/// Writer of a packed scene, part by part.
pub(super) struct Packer<W> {
    out: W,
    max_error_px: f32,
    antialiased: Option<bool>,
    /// Per part: blocks of the finest level, degree.
    parts: Vec<[u32; 2]>,
    /// Table rows of all blocks.
    rows: Vec<u8>,
    summary: PackSummary,
    bytes: Vec<u8>,
}

/// Why a part cannot be added.
#[derive(Debug)]
pub(super) enum AddError {
    Io(io::Error),
    Mixed,
}

impl<W: Write + Seek> Packer<W> {
    pub(super) fn new(mut out: W, max_error_px: f32) -> io::Result<Self> {
        out.write_all(&[0; HEADER])?;
        Ok(Self {
            out,
            max_error_px,
            antialiased: None,
            parts: Vec::new(),
            rows: Vec::new(),
            summary: PackSummary::default(),
            bytes: Vec::new(),
        })
    }

    /// Adds a part; skips it if it has no visible splats.
    pub(super) fn add(&mut self, splats: &Splats) -> Result<(), AddError> {
        let part = Part::new(0, splats, Detail::Adaptive { max_error_px: self.max_error_px });
        if part.len == 0 {
            return Ok(());
        }
        if *self.antialiased.get_or_insert(part.antialiased) != part.antialiased {
            return Err(AddError::Mixed);
        }
        let finest = part.levels.get(1).copied().unwrap_or(part.blocks.len());
        self.parts.push([finest as u32, u32::from(splats.sh_degree)]);
        let harmonics = part.sh_numbers() * BLOCK;
        for (i, block) in part.blocks.iter().enumerate() {
            self.bytes.clear();
            for number in &part.geometry[i * GEOMETRY..][..GEOMETRY] {
                self.bytes.extend_from_slice(&number.to_le_bytes());
            }
            for half in &part.sh[i * harmonics..][..harmonics] {
                self.bytes.extend_from_slice(&half.to_le_bytes());
            }
            self.out.write_all(&self.bytes).map_err(AddError::Io)?;
            let Block { center_m, half_m, reach_m, error_m } = block;
            for number in [center_m.to_array(), half_m.to_array()].as_flattened() {
                self.rows.extend_from_slice(&number.to_le_bytes());
            }
            self.rows.extend_from_slice(&reach_m.to_le_bytes());
            self.rows.extend_from_slice(&error_m.to_le_bytes());
            self.rows.extend_from_slice(&checksum(&[&self.bytes]).to_le_bytes());
        }
        self.summary.parts += 1;
        self.summary.splats += part.len;
        self.summary.blocks += part.blocks.len();
        Ok(())
    }

    /// Writes the tables and the header.
    pub(super) fn finish(mut self) -> io::Result<PackSummary> {
        if self.parts.is_empty() {
            return Err(io::Error::new(
                io::ErrorKind::InvalidData,
                "the scene has no visible splats",
            ));
        }
        let mut tables: Vec<u8> = Vec::with_capacity(self.parts.len() * PART + self.rows.len());
        tables.extend(self.parts.as_flattened().iter().flat_map(|number| number.to_le_bytes()));
        tables.append(&mut self.rows);
        self.out.write_all(&tables)?;
        let PackSummary { parts, splats, blocks } = self.summary;
        let mut header = MAGIC.to_vec();
        header.extend(VERSION.to_le_bytes());
        header.extend((parts as u32).to_le_bytes());
        header.extend((blocks as u64).to_le_bytes());
        header.extend((splats as u64).to_le_bytes());
        header.extend(self.max_error_px.to_le_bytes());
        header.extend(u32::from(self.antialiased == Some(true)).to_le_bytes());
        let check = checksum(&[&header, &tables]);
        header.extend(check.to_le_bytes());
        header.resize(HEADER, 0);
        self.out.rewind()?;
        self.out.write_all(&header)?;
        self.out.flush()?;
        Ok(self.summary)
    }
}
