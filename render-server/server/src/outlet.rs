//! Who wants images at this moment, and the way out to them.
//!
//! A runtime's session opens its vehicle's way out; for each camera at most K images may be in flight
//! (handed to the transport, not yet acknowledged). Viewers of the page are counted. The render
//! thread rests while nobody wants anything; the encode thread takes the newest drawn tick only
//! when a camera has room, so that what waits is always the newest, and nothing is encoded that
//! could not leave. Buffers come back through [`Outlet::recycle`].

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use tokio::sync::mpsc;
use vizflyt_protocol::messages::MAX_CAMERAS;
use vizflyt_protocol::packet::ImageHeader;

use crate::hub::MAX_VEHICLES;

/// One encoded image on its way to the session.
#[derive(Debug)]
pub struct Outgoing {
    /// Index of the vehicle.
    pub vehicle: usize,
    /// Index into the vehicle's cameras.
    pub camera: usize,
    /// Goes before the bitstream.
    pub header: ImageHeader,
    /// The bitstream.
    pub payload: Vec<u8>,
}

/// What the encode thread may do now.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// By vehicle and camera: the session has room for an image.
    pub stream: [[bool; MAX_CAMERAS]; MAX_VEHICLES],
    /// No runtime wants anything, but a page does: drawn ticks go on to the previews.
    pub pass_on: bool,
}

impl Wanted {
    /// Whether anyone wants anything.
    pub fn anything(&self) -> bool {
        self.pass_on || self.stream.as_flattened().contains(&true)
    }
}

/// Demand and way out; shared by the render, encode and transport sides.
#[derive(Debug)]
pub struct Outlet {
    state: Mutex<State>,
    changed: Condvar,
    buffers: Mutex<Vec<Vec<u8>>>,
}

#[derive(Debug, Default)]
struct State {
    vehicles: Vec<Way>,
    closed: bool,
}

/// Who wants the images of one vehicle.
#[derive(Debug, Default)]
struct Way {
    cameras: usize,
    session: Option<Session>,
    viewers: u32,
}

impl Way {
    fn session(&mut self, id: u64) -> Option<&mut Session> {
        self.session.as_mut().filter(|session| session.id == id)
    }

    fn is_wanted(&self) -> bool {
        self.session.is_some() || self.viewers > 0
    }
}

#[derive(Debug)]
struct Session {
    id: u64,
    allowed: u32,
    in_flight: [u32; MAX_CAMERAS],
    images: mpsc::UnboundedSender<Outgoing>,
}

impl Outlet {
    /// Makes the outlet of vehicles with this many cameras each (at most [`MAX_CAMERAS`] of at
    /// most [`MAX_VEHICLES`]).
    pub fn new(cameras: &[usize]) -> Self {
        let way = |&cameras: &usize| Way { cameras: cameras.min(MAX_CAMERAS), ..Way::default() };
        let vehicles = cameras.iter().take(MAX_VEHICLES).map(way).collect();
        Self {
            state: Mutex::new(State { vehicles, closed: false }),
            changed: Condvar::new(),
            buffers: Mutex::default(),
        }
    }

    /// Lets images flow to session `id` of a vehicle, at most `allowed` in flight per camera, in place of any
    /// earlier session. The channel holds no more than that, for the count bounds it.
    pub fn open(&self, vehicle: usize, id: u64, allowed: u32) -> mpsc::UnboundedReceiver<Outgoing> {
        let (images, receiver) = mpsc::unbounded_channel();
        let session = Session { id, allowed, in_flight: [0; MAX_CAMERAS], images };
        self.lock().vehicles[vehicle].session = Some(session);
        self.changed.notify_all();
        receiver
    }

    /// Stops the flow to session `id` of a vehicle.
    pub fn close(&self, vehicle: usize, id: u64) {
        self.lock().vehicles[vehicle].session.take_if(|session| session.id == id);
    }

    /// Sets how many images of each camera session `id` of a vehicle may have in flight.
    pub fn allow(&self, vehicle: usize, id: u64, allowed: u32) {
        if let Some(session) = self.lock().vehicles[vehicle].session(id) {
            session.allowed = allowed;
        }
        self.changed.notify_all();
    }

    /// Hands an image to the session; returns whether there is one.
    pub fn send(&self, image: Outgoing) -> bool {
        let mut state = self.lock();
        let refused = match &mut state.vehicles[image.vehicle].session {
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

    /// Tells that an image of session `id` of a vehicle is no longer in flight.
    pub fn landed(&self, vehicle: usize, id: u64, camera: usize) {
        if let Some(session) = self.lock().vehicles[vehicle].session(id) {
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

    /// Counts a viewer of a vehicle's page until [`Self::viewer_left`].
    pub fn viewer_came(&self, vehicle: usize) {
        self.lock().vehicles[vehicle].viewers += 1;
        self.changed.notify_all();
    }

    /// Counts a viewer out.
    pub fn viewer_left(&self, vehicle: usize) {
        let viewers = &mut self.lock().vehicles[vehicle].viewers;
        *viewers = viewers.saturating_sub(1);
    }

    /// Returns the number of viewers of all vehicles.
    pub fn viewers(&self) -> u32 {
        self.lock().vehicles.iter().map(|way| way.viewers).sum()
    }

    /// Returns which vehicles' pages someone watches.
    pub fn watched(&self) -> [bool; MAX_VEHICLES] {
        let mut watched = [false; MAX_VEHICLES];
        for (watched, way) in watched.iter_mut().zip(&self.lock().vehicles) {
            *watched = way.viewers > 0;
        }
        watched
    }

    /// Waits at most `timeout` until someone wants images; returns of which vehicles.
    pub fn wait_for_interest(&self, timeout: Duration) -> [bool; MAX_VEHICLES] {
        let idle = |state: &mut State| !state.closed && !state.vehicles.iter().any(Way::is_wanted);
        let (state, _) = self
            .changed
            .wait_timeout_while(self.lock(), timeout, idle)
            .unwrap_or_else(PoisonError::into_inner);
        let mut wanted = [false; MAX_VEHICLES];
        for (wanted, way) in wanted.iter_mut().zip(&state.vehicles) {
            *wanted = !state.closed && way.is_wanted();
        }
        wanted
    }

    /// Waits at most `timeout` until an image may be encoded: a session has room for one, or there
    /// is none but a page that wants previews. Returns for whom.
    pub fn wait_for_room(&self, timeout: Duration) -> Wanted {
        let deadline = Instant::now() + timeout;
        let mut state = self.lock();
        loop {
            let now = Instant::now();
            let mut wanted = Wanted::default();
            let ways = &state.vehicles;
            wanted.pass_on = ways.iter().any(|way| way.viewers > 0)
                && ways.iter().all(|way| way.session.is_none());
            for (vehicle, way) in ways.iter().enumerate() {
                let Some(session) = &way.session else { continue };
                for camera in 0..way.cameras {
                    wanted.stream[vehicle][camera] = session.in_flight[camera] < session.allowed;
                }
            }
            if state.closed || wanted.anything() || now >= deadline {
                return if state.closed { Wanted::default() } else { wanted };
            }
            let left = deadline.saturating_duration_since(now);
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
        Outgoing { vehicle: 0, camera, header, payload: outlet.buffer() }
    }

    #[test]
    fn at_most_k_images_of_each_camera_are_in_flight() {
        let outlet = Outlet::new(&[2]);
        assert_eq!(outlet.wait_for_room(NOT_YET), Wanted::default());
        let mut images = outlet.open(0, 7, 2);
        assert!(outlet.send(image(&outlet, 0)));
        assert!(outlet.send(image(&outlet, 0)));
        let wanted = outlet.wait_for_room(LONG);
        assert_eq!(wanted.stream[0][..2], [false, true], "camera 1 is not held up by camera 0");
        outlet.send(image(&outlet, 1));
        outlet.send(image(&outlet, 1));
        assert_eq!(outlet.wait_for_room(NOT_YET), Wanted::default());
        assert_eq!(images.try_recv().unwrap().camera, 0);
        outlet.landed(0, 7, 0);
        assert_eq!(outlet.wait_for_room(LONG).stream[0][..2], [true, false]);
        outlet.allow(0, 7, 3);
        assert_eq!(outlet.wait_for_room(LONG).stream[0][..2], [true, true]);
    }

    #[test]
    fn an_old_session_does_not_disturb_a_new_one() {
        let outlet = Outlet::new(&[1]);
        let _old = outlet.open(0, 1, 1);
        outlet.send(image(&outlet, 0));
        let _new = outlet.open(0, 2, 1);
        outlet.send(image(&outlet, 0));
        outlet.landed(0, 1, 0);
        outlet.close(0, 1);
        assert_eq!(outlet.wait_for_room(NOT_YET), Wanted::default());
        outlet.landed(0, 2, 0);
        assert!(outlet.wait_for_room(LONG).stream[0][0]);
        outlet.close(0, 2);
        assert!(!outlet.send(image(&outlet, 0)));
    }

    #[test]
    fn a_page_alone_has_ticks_passed_on_and_a_session_has_them_first() {
        let outlet = Outlet::new(&[1]);
        assert!(!outlet.wait_for_interest(NOT_YET)[0]);
        outlet.viewer_came(0);
        assert!(outlet.wait_for_interest(LONG)[0]);
        assert!(outlet.wait_for_room(LONG).pass_on && outlet.watched()[0]);
        let images = outlet.open(0, 1, 0);
        assert_eq!(outlet.wait_for_room(NOT_YET), Wanted::default(), "no room, and no ticks lost");
        drop(images);
        outlet.close(0, 1);
        assert!(outlet.wait_for_room(LONG).pass_on);
        outlet.viewer_left(0);
        assert_eq!(outlet.wait_for_room(NOT_YET), Wanted::default());
        outlet.viewer_came(0);
        outlet.shut();
        assert!(!outlet.wait_for_interest(LONG)[0]);
        assert_eq!(outlet.wait_for_room(LONG), Wanted::default());
    }
}
