//! Who wants images at this moment, and the way out to them.
//!
//! The runtime's session opens the outlet; for each camera at most K images may be in flight
//! (handed to the transport, not yet acknowledged). Viewers of the page are counted. The render
//! thread rests while nobody wants anything; the encode thread takes the newest drawn tick only
//! when a camera has room, so that what waits is always the newest, and nothing is encoded that
//! could not leave. Buffers come back through [`Outlet::recycle`].

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::mpsc;
use vizflyt_protocol::messages::MAX_CAMERAS;
use vizflyt_protocol::packet::ImageHeader;

/// One encoded image on its way to the session.
#[derive(Debug)]
pub struct Outgoing {
    /// Index into the arena's cameras.
    pub camera: usize,
    /// Goes before the bitstream.
    pub header: ImageHeader,
    /// The bitstream.
    pub payload: Vec<u8>,
}

/// What the encode thread may do now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// By camera: the session has room for an image.
    pub stream: [bool; MAX_CAMERAS],
    /// A page wants a preview, and one is due.
    pub preview: bool,
}

impl Wanted {
    fn anything(&self) -> bool {
        self.preview || self.stream.contains(&true)
    }
}

/// Demand and way out; shared by the render, encode and transport sides.
#[derive(Debug)]
pub struct Outlet {
    cameras: usize,
    state: Mutex<State>,
    changed: Condvar,
    buffers: Mutex<Vec<Vec<u8>>>,
}

#[derive(Debug, Default)]
struct State {
    session: Option<Session>,
    viewers: u32,
    closed: bool,
}

#[derive(Debug)]
struct Session {
    id: u64,
    allowed: u32,
    in_flight: [u32; MAX_CAMERAS],
    images: mpsc::UnboundedSender<Outgoing>,
}

impl Outlet {
    /// Makes the outlet of an arena with this many cameras (at most [`MAX_CAMERAS`]).
    pub fn new(cameras: usize) -> Self {
        Self {
            cameras: cameras.min(MAX_CAMERAS),
            state: Mutex::default(),
            changed: Condvar::new(),
            buffers: Mutex::default(),
        }
    }

    /// Lets images flow to session `id`, at most `allowed` in flight per camera, in place of any
    /// earlier session. The channel holds no more than that, for the count bounds it.
    pub fn open(&self, id: u64, allowed: u32) -> mpsc::UnboundedReceiver<Outgoing> {
        let (images, receiver) = mpsc::unbounded_channel();
        self.lock().session = Some(Session { id, allowed, in_flight: [0; MAX_CAMERAS], images });
        self.changed.notify_all();
        receiver
    }

    /// Stops the flow to session `id`.
    pub fn close(&self, id: u64) {
        let mut state = self.lock();
        if state.session.as_ref().is_some_and(|session| session.id == id) {
            state.session = None;
        }
    }

    /// Sets how many images of each camera session `id` may have in flight.
    pub fn allow(&self, id: u64, allowed: u32) {
        if let Some(session) = self.lock().session.as_mut().filter(|session| session.id == id) {
            session.allowed = allowed;
        }
        self.changed.notify_all();
    }

    /// Hands an image to the session; returns whether there is one.
    pub fn send(&self, image: Outgoing) -> bool {
        let mut state = self.lock();
        let refused = match &mut state.session {
            Some(session) => {
                session.in_flight[image.camera] += 1;
                session.images.send(image).err().map(|error| error.0)
            }
            None => Some(image),
        };
        drop(state);
        match refused {
            Some(image) => {
                self.recycle(image.payload);
                false
            }
            None => true,
        }
    }

    /// Tells that an image of session `id` is no longer in flight.
    pub fn landed(&self, id: u64, camera: usize) {
        if let Some(session) = self.lock().session.as_mut().filter(|session| session.id == id) {
            session.in_flight[camera] = session.in_flight[camera].saturating_sub(1);
        }
        self.changed.notify_all();
    }

    /// Returns an empty buffer to encode into.
    pub fn buffer(&self) -> Vec<u8> {
        let mut buffers = self.buffers.lock().unwrap_or_else(PoisonError::into_inner);
        let mut buffer = buffers.pop().unwrap_or_default();
        buffer.clear();
        buffer
    }

    /// Gives a buffer back.
    pub fn recycle(&self, buffer: Vec<u8>) {
        let mut buffers = self.buffers.lock().unwrap_or_else(PoisonError::into_inner);
        if buffers.len() < MOST_BUFFERS {
            buffers.push(buffer);
        }
    }

    /// Counts a viewer of the page until [`Self::viewer_left`].
    pub fn viewer_came(&self) {
        self.lock().viewers += 1;
        self.changed.notify_all();
    }

    /// Counts a viewer out.
    pub fn viewer_left(&self) {
        let mut state = self.lock();
        state.viewers = state.viewers.saturating_sub(1);
    }

    /// Returns the number of viewers.
    pub fn viewers(&self) -> u32 {
        self.lock().viewers
    }

    /// Waits at most `timeout` until someone wants images; returns whether someone does.
    pub fn wait_for_interest(&self, timeout: Duration) -> bool {
        let interested =
            |state: &mut State| !state.closed && state.session.is_none() && state.viewers == 0;
        let (state, _) = self
            .changed
            .wait_timeout_while(self.lock(), timeout, interested)
            .unwrap_or_else(PoisonError::into_inner);
        !state.closed && (state.session.is_some() || state.viewers > 0)
    }

    /// Waits at most `timeout` until an image may be encoded: the session has room for one, or a
    /// page wants a preview and `preview_due` has passed. Returns for whom.
    pub fn wait_for_room(&self, preview_due: Instant, timeout: Duration) -> Wanted {
        let deadline = Instant::now() + timeout;
        let mut state = self.lock();
        loop {
            let now = Instant::now();
            let mut wanted =
                Wanted { preview: state.viewers > 0 && now >= preview_due, ..Wanted::default() };
            if let Some(session) = &state.session {
                for camera in 0..self.cameras {
                    wanted.stream[camera] = session.in_flight[camera] < session.allowed;
                }
            }
            if state.closed || wanted.anything() || now >= deadline {
                return if state.closed { Wanted::default() } else { wanted };
            }
            let until = if state.viewers > 0 { deadline.min(preview_due) } else { deadline };
            let left = until.saturating_duration_since(now);
            state =
                self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Wakes everyone who waits, for good.
    pub fn shut(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Why: no code panics while it holds the lock.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// More than K of every camera of a usual vehicle.
const MOST_BUFFERS: usize = 16;

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::{Intrinsics, Pose};
    use vizflyt_protocol::time::ServerTime;

    const LONG: Duration = Duration::from_secs(30);
    const NOT_YET: Duration = Duration::from_millis(1);

    fn far() -> Instant {
        Instant::now() + LONG
    }

    fn image(outlet: &Outlet, camera: usize) -> Outgoing {
        let k = Intrinsics::from_horizontal_fov(4, 3, 1.0);
        let header = ImageHeader::new(
            1,
            camera as u8,
            ServerTime::ZERO,
            &k,
            &Pose::IDENTITY,
            &Pose::IDENTITY,
        );
        Outgoing { camera, header, payload: outlet.buffer() }
    }

    #[test]
    fn at_most_k_images_of_each_camera_are_in_flight() {
        let outlet = Outlet::new(2);
        assert_eq!(outlet.wait_for_room(far(), NOT_YET), Wanted::default());
        let mut images = outlet.open(7, 2);
        assert!(outlet.send(image(&outlet, 0)));
        assert!(outlet.send(image(&outlet, 0)));
        let wanted = outlet.wait_for_room(far(), LONG);
        assert_eq!(wanted.stream[..2], [false, true], "camera 1 is not held up by camera 0");
        outlet.send(image(&outlet, 1));
        outlet.send(image(&outlet, 1));
        assert_eq!(outlet.wait_for_room(far(), NOT_YET), Wanted::default());
        assert_eq!(images.try_recv().unwrap().camera, 0);
        outlet.landed(7, 0);
        assert_eq!(outlet.wait_for_room(far(), LONG).stream[..2], [true, false]);
        outlet.allow(7, 3);
        assert_eq!(outlet.wait_for_room(far(), LONG).stream[..2], [true, true]);
    }

    #[test]
    fn an_old_session_does_not_disturb_a_new_one() {
        let outlet = Outlet::new(1);
        let _old = outlet.open(1, 1);
        outlet.send(image(&outlet, 0));
        let _new = outlet.open(2, 1);
        outlet.send(image(&outlet, 0));
        outlet.landed(1, 0);
        outlet.close(1);
        assert_eq!(outlet.wait_for_room(far(), NOT_YET), Wanted::default());
        outlet.landed(2, 0);
        assert!(outlet.wait_for_room(far(), LONG).stream[0]);
        outlet.close(2);
        assert!(!outlet.send(image(&outlet, 0)));
    }

    #[test]
    fn previews_wait_for_a_viewer_and_for_their_time() {
        let outlet = Outlet::new(1);
        assert!(!outlet.wait_for_interest(NOT_YET));
        outlet.viewer_came();
        assert!(outlet.wait_for_interest(LONG));
        assert!(!outlet.wait_for_room(far(), NOT_YET).preview);
        let soon = Instant::now() + Duration::from_millis(5);
        assert!(outlet.wait_for_room(soon, LONG).preview);
        outlet.viewer_left();
        assert!(!outlet.wait_for_room(soon, NOT_YET).preview);
        outlet.viewer_came();
        outlet.shut();
        assert!(!outlet.wait_for_interest(LONG));
        assert_eq!(outlet.wait_for_room(soon, LONG), Wanted::default());
    }
}
