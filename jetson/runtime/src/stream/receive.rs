//! Receives image streams into the mailbox, piece by piece as they arrive, and readings of other sensors
//! as a whole.
//!
//! A few tasks wait for the next stream until the connection ends. At least one task is always waiting, so
//! images do not wait for each other. Bytes are copied once, from the transport's packets into a piece of
//! the mailbox; in the steady state, the runtime allocates nothing per image.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use quinn::{Connection, ReadExactError, RecvStream, VarInt};
use tokio::time::timeout;
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer};
use vizflyt_protocol::sensor::ReadingHeader;
use vizflyt_rgbd::{HEADER_BYTES, Info, SLICE_HEADER_BYTES, peek, slice_len};

use super::mailbox::{Arrival, Ticket, Whole};
use super::readings::{self, Reading};
use super::{IMAGES_AT_ONCE, Shared};
use crate::clock;

/// Timeout of an image, which would then be stale. The server gives up after 150 ms.
const IMAGE_WITHIN: Duration = Duration::from_millis(500);
/// Maximum growth of a buffer ahead of the received bytes, regardless of the announced length. [bytes]
const GROWTH: usize = 64 << 10;

/// Reason for dropping an image.
#[derive(Debug, thiserror::Error)]
enum Lost {
    #[error(transparent)]
    Cut(#[from] ReadExactError),
    #[error(transparent)]
    Header(#[from] vizflyt_protocol::packet::InvalidImageHeader),
    #[error(transparent)]
    Bitstream(#[from] vizflyt_rgbd::DecodeError),
    #[error(transparent)]
    Trailer(#[from] vizflyt_protocol::packet::InvalidImageTrailer),
    #[error(transparent)]
    Reading(#[from] vizflyt_protocol::sensor::InvalidReading),
    #[error("more bytes than the maximum for its size")]
    Long,
    #[error("its bitstream has another size than its header")]
    Size,
    #[error("it arrived before the first clock exchange")]
    Clock,
    #[error("a newer image arrived first")]
    Stale,
}

/// Starts tasks that receive images until the connection ends.
pub(super) fn start(connection: &Connection, shared: &Shared) {
    let receivers = Receivers {
        connection: connection.clone(),
        shared: shared.clone(),
        session: shared.mailbox.session(),
        waiting: Arc::default(),
        all: Arc::default(),
    };
    receivers.spawn();
}

#[derive(Clone)]
struct Receivers {
    connection: Connection,
    shared: Shared,
    session: u64,
    /// Number of tasks that wait for a stream.
    waiting: Arc<AtomicUsize>,
    all: Arc<AtomicUsize>,
}

impl Receivers {
    fn spawn(&self) {
        self.all.fetch_add(1, Ordering::Relaxed);
        self.waiting.fetch_add(1, Ordering::Relaxed);
        tokio::spawn(self.clone().run());
    }

    async fn run(self) {
        let mut piece = Vec::new();
        while let Ok(mut stream) = self.connection.accept_uni().await {
            let was_last = self.waiting.fetch_sub(1, Ordering::Relaxed) == 1;
            if was_last && self.all.load(Ordering::Relaxed) < IMAGES_AT_ONCE as usize {
                self.spawn();
            }
            self.receive(&mut stream, &mut piece).await;
            self.waiting.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// Receives one image or reading. Drops it if it is truncated, late or invalid: the next one arrives shortly.
    async fn receive(&self, stream: &mut RecvStream, piece: &mut Vec<u8>) {
        let mut ticket = None;
        let result = timeout(IMAGE_WITHIN, self.whole(stream, piece, &mut ticket)).await;
        let why = match result {
            Ok(Ok(whole)) => {
                if let Some(ticket) = ticket {
                    self.shared.mailbox.end(ticket, whole);
                }
                return;
            }
            Ok(Err(lost)) => lost.to_string(),
            Err(_) => "it was not complete within 500 ms".to_owned(),
        };
        if let Some(ticket) = ticket {
            self.shared.mailbox.end(ticket, None);
        }
        // Fails only if the stream has ended or was stopped already.
        let _ = stream.stop(VarInt::from_u32(0));
        tracing::debug!("image dropped: {why}");
    }

    /// Receives an image or a reading, depending on the stream's first bytes. Returns the end of an image.
    async fn whole(
        &self,
        stream: &mut RecvStream,
        piece: &mut Vec<u8>,
        ticket: &mut Option<Ticket>,
    ) -> Result<Option<Whole>, Lost> {
        let mut magic = [0; ReadingHeader::MAGIC.len()];
        stream.read_exact(&mut magic).await?;
        if magic == ReadingHeader::MAGIC {
            self.reading(stream, magic).await?;
            return Ok(None);
        }
        self.pieces(stream, magic, piece, ticket).await.map(Some)
    }

    /// Receives a reading of a sensor other than a camera.
    async fn reading(&self, stream: &mut RecvStream, magic: [u8; 4]) -> Result<(), Lost> {
        let mut bytes = [0; ReadingHeader::SIZE];
        let (first, rest) = bytes.split_at_mut(magic.len());
        first.copy_from_slice(&magic);
        stream.read_exact(rest).await?;
        let (header, len) = readings::head(&bytes)?;
        let clock = &self.shared.clock;
        let pose = clock.to_host(header.pose_stamp()).ok_or(Lost::Clock)?;
        let shown = clock.to_host(header.stamp()).ok_or(Lost::Clock)?;
        let mut records = Vec::new();
        read(stream, &mut records, len).await?;
        let received = clock::now();
        self.shared.readings.put(Reading { header, pose, shown, received, records });
        Ok(())
    }

    async fn pieces(
        &self,
        stream: &mut RecvStream,
        magic: [u8; 4],
        piece: &mut Vec<u8>,
        ticket: &mut Option<Ticket>,
    ) -> Result<Whole, Lost> {
        let mut head = [0; ImageHeader::SIZE];
        let (front, rest) = head.split_at_mut(magic.len());
        front.copy_from_slice(&magic);
        stream.read_exact(rest).await?;
        let first = clock::now();
        let (header, _) = ImageHeader::parse(&head)?;
        let pose = self.shared.clock.to_host(header.pose_stamp()).ok_or(Lost::Clock)?;
        let arrival = Arrival { session: self.session, header, pose, first };
        let ticket = *ticket.insert(self.shared.mailbox.open(&arrival).ok_or(Lost::Stale)?);

        let most = header.most_payload();
        let mut came = 0;
        piece.clear();
        read(stream, piece, HEADER_BYTES).await?;
        let info = peek(piece)?;
        if (info.width, info.height) != (header.width_px.get(), header.height_px.get()) {
            return Err(Lost::Size);
        }
        read(stream, piece, info.header_len).await?;
        self.push(ticket, piece, &mut came)?;
        self.slices(stream, piece, ticket, &info, most, &mut came).await?;

        let mut tail = [0; ImageTrailer::SIZE];
        stream.read_exact(&mut tail).await?;
        let trailer = ImageTrailer::parse(&tail, came)?;
        Ok(Whole { trailer, received: clock::now() })
    }

    async fn slices(
        &self,
        stream: &mut RecvStream,
        piece: &mut Vec<u8>,
        ticket: Ticket,
        info: &Info,
        most: u64,
        came: &mut u64,
    ) -> Result<(), Lost> {
        for _ in 0..info.slices {
            piece.clear();
            read(stream, piece, SLICE_HEADER_BYTES).await?;
            let len = slice_len(piece).ok_or(Lost::Long)?;
            if came.saturating_add(len) > most {
                return Err(Lost::Long);
            }
            read(stream, piece, len as usize).await?;
            self.push(ticket, piece, came)?;
        }
        Ok(())
    }

    fn push(&self, ticket: Ticket, piece: &mut Vec<u8>, came: &mut u64) -> Result<(), Lost> {
        *came += piece.len() as u64;
        if self.shared.mailbox.push(ticket, piece) { Ok(()) } else { Err(Lost::Stale) }
    }
}

/// Reads until `piece` contains `len` bytes.
async fn read(
    stream: &mut RecvStream,
    piece: &mut Vec<u8>,
    len: usize,
) -> Result<(), ReadExactError> {
    while piece.len() < len {
        let start = piece.len();
        piece.resize(len.min(start + GROWTH), 0);
        stream.read_exact(&mut piece[start..]).await?;
    }
    Ok(())
}
