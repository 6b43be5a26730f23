//! Image subscriptions, and delivery to subscribers.
//!
//! A vehicle's images go to its runtime and to at most
//! [`MAX_WATCHERS`](crate::flights::control_lease::MAX_WATCHERS) watchers. At most K images per camera may be
//! in flight to each subscriber (handed to the transport, not yet acknowledged). The encode thread takes the
//! newest rendered tick only when a subscriber has room. So the waiting image is always the newest, and no
//! image is encoded that could not be sent. An image is encoded once, for all subscribers with room
//! ([`Subscriptions::begin`]).
//!
//! Watchers never delay the runtime: while a runtime is connected, its watchers get the same images. Images are
//! encoded only for watchers if the runtime has had no room for [`STALLED_S`].
//!
//! Viewers of the page are counted. The render thread rests while there are neither subscribers nor viewers.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use vizflyt_process::lock;

use bytes::Bytes;
use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_protocol::messages::{MAX_CAMERAS, Purpose};
use vizflyt_protocol::packet::ImageHeader;
use vizflyt_protocol::time::ServerTime;

use crate::clock;
pub use crate::stream::in_flight::{InFlightImage, Part};

/// Images that the encode thread may encode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wanted {
    /// By vehicle and camera: at least one subscriber has room for an image.
    pub stream: [[bool; MAX_CAMERAS]; MAX_VEHICLES],
    /// By vehicle and camera: the runtime has room for an image.
    pub fly: [[bool; MAX_CAMERAS]; MAX_VEHICLES],
    /// No sessions, but at least one page: rendered ticks go on to the previews.
    pub pass_on: bool,
}

impl Wanted {
    /// Returns whether any images are wanted.
    pub fn anything(&self) -> bool {
        self.pass_on || self.stream.as_flattened().contains(&true)
    }
}

/// Demand for images, and their slots; shared by the render, encode and transport sides.
#[derive(Debug)]
pub struct Subscriptions {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    vehicles: Vec<VehicleSubscribers>,
    closed: bool,
}

/// Subscribers of one vehicle's images.
#[derive(Debug, Default)]
struct VehicleSubscribers {
    cameras: usize,
    subscribers: Vec<Subscriber>,
    viewers: u32,
}

/// Session that receives images.
#[derive(Debug)]
struct Subscriber {
    id: u64,
    purpose: Purpose,
    allowed: u32,
    cameras: Vec<CameraSlots>,
}

/// Images of one camera in flight to one subscriber.
#[derive(Debug)]
struct CameraSlots {
    all: Vec<Arc<InFlightImage>>,
    /// One bit per used slot.
    taken: u8,
    /// Time at which the last free slot was taken.
    full_since: ServerTime,
}

/// Image slots of a subscriber by camera, [`MAX_IN_FLIGHT`] of each.
pub type Slots = Vec<Vec<Arc<InFlightImage>>>;

/// Image in flight to all subscribers that had room when it began. Reused for the next image.
#[derive(Debug, Default)]
pub struct Broadcast {
    vehicle: usize,
    camera: usize,
    to: Vec<(u64, usize, Arc<InFlightImage>)>,
}

impl Broadcast {
    /// Returns whether no subscriber had room.
    pub fn is_empty(&self) -> bool {
        self.to.is_empty()
    }

    /// Passes the next bytes of bitstream to all subscribers.
    pub fn push(&self, bytes: &Bytes) {
        for (.., image) in &self.to {
            image.push(bytes.clone());
        }
    }
}

impl VehicleSubscribers {
    fn subscriber(&mut self, id: u64) -> Option<&mut Subscriber> {
        self.subscribers.iter_mut().find(|subscriber| subscriber.id == id)
    }

    fn is_wanted(&self) -> bool {
        !self.subscribers.is_empty() || self.viewers > 0
    }

    fn has_watcher(&self) -> bool {
        self.subscribers.iter().any(|subscriber| subscriber.purpose == Purpose::Watch)
    }

    /// Returns whether an image of this camera may be encoded for the runtime, and for any subscriber.
    fn room(&self, camera: usize, now: ServerTime) -> (bool, bool) {
        let has_room = |subscriber: &Subscriber| subscriber.room(camera).is_some();
        let is_watcher = |subscriber: &&Subscriber| subscriber.purpose == Purpose::Watch;
        let watchers = self.subscribers.iter().filter(is_watcher).any(has_room);
        let runtime = self.subscribers.iter().find(|s| s.purpose == Purpose::Fly);
        let Some(runtime) = runtime else { return (false, watchers) };
        let fly = has_room(runtime);
        let stalled = |slots: &CameraSlots| now.seconds_since(slots.full_since) > STALLED_S;
        let is_stalled = !fly && runtime.cameras.get(camera).is_some_and(stalled);
        (fly, fly || (watchers && is_stalled))
    }
}

impl Subscriber {
    /// Returns the index of a free slot.
    fn room(&self, camera: usize) -> Option<usize> {
        let slots = self.cameras.get(camera)?;
        let free = (!slots.taken).trailing_zeros() as usize;
        (slots.taken.count_ones() < self.allowed && free < slots.all.len()).then_some(free)
    }
}

impl Subscriptions {
    /// Creates the subscriptions of vehicles with this many cameras each (at most [`MAX_CAMERAS`] of at most
    /// [`MAX_VEHICLES`]).
    pub fn new(cameras: &[usize]) -> Self {
        let vehicle = |&cameras: &usize| VehicleSubscribers {
            cameras: cameras.min(MAX_CAMERAS),
            ..VehicleSubscribers::default()
        };
        let vehicles = cameras.iter().take(MAX_VEHICLES).map(vehicle).collect();
        Self { state: Mutex::new(State { vehicles, closed: false }), changed: Condvar::new() }
    }

    /// Subscribes session `id` to a vehicle's images, at most `allowed` in flight per camera. A runtime
    /// replaces an earlier one. Returns the image slots.
    pub fn open(&self, vehicle: usize, id: u64, purpose: Purpose, allowed: u32) -> Slots {
        let mut state = self.lock();
        let vehicle = &mut state.vehicles[vehicle];
        if purpose == Purpose::Fly {
            vehicle.subscribers.retain(|subscriber| subscriber.purpose != Purpose::Fly);
        }
        let places = |_| (0..MAX_IN_FLIGHT).map(|_| Arc::default()).collect::<Vec<_>>();
        let all: Slots = (0..vehicle.cameras).map(places).collect();
        let slots = |all| CameraSlots { all, taken: 0, full_since: ServerTime::ZERO };
        let cameras = all.iter().cloned().map(slots).collect();
        vehicle.subscribers.push(Subscriber { id, purpose, allowed, cameras });
        drop(state);
        self.changed.notify_all();
        all
    }

    /// Ends the subscription of session `id` of a vehicle.
    pub fn close(&self, vehicle: usize, id: u64) {
        self.lock().vehicles[vehicle].subscribers.retain(|subscriber| subscriber.id != id);
        self.changed.notify_all();
    }

    /// Sets the maximum of images in flight per camera for session `id` of a vehicle.
    pub fn allow(&self, vehicle: usize, id: u64, allowed: u32) {
        if let Some(subscriber) = self.lock().vehicles[vehicle].subscriber(id) {
            subscriber.allowed = allowed;
        }
        self.changed.notify_all();
    }

    /// Begins an image of a vehicle's camera with this stream priority, for all watchers with room, and for the
    /// runtime if it has room and `to_runtime` is set. Call [`Self::end`] afterwards.
    pub fn begin(
        &self,
        (vehicle, camera): (usize, usize),
        header: ImageHeader,
        priority: i32,
        to_runtime: bool,
        broadcast: &mut Broadcast,
    ) {
        broadcast.to.clear();
        (broadcast.vehicle, broadcast.camera) = (vehicle, camera);
        let mut state = self.lock();
        let Some(vehicle) = state.vehicles.get_mut(vehicle) else { return };
        for subscriber in &mut vehicle.subscribers {
            if subscriber.purpose == Purpose::Fly && !to_runtime {
                continue;
            }
            let Some(free) = subscriber.room(camera) else { continue };
            let slots = &mut subscriber.cameras[camera];
            slots.taken |= 1 << free;
            if slots.taken.count_ones() >= subscriber.allowed {
                slots.full_since = clock::now();
            }
            slots.all[free].begin(header, priority);
            broadcast.to.push((subscriber.id, free, slots.all[free].clone()));
        }
    }

    /// Ends the image: complete, or with `None` incomplete.
    pub fn end(&self, broadcast: &mut Broadcast, encode_end: Option<ServerTime>) {
        let (vehicle, camera) = (broadcast.vehicle, broadcast.camera);
        for (id, place, image) in broadcast.to.drain(..) {
            if image.end(encode_end) {
                self.free(vehicle, camera, id, place);
            }
        }
    }

    /// Releases the slot of an image of session `id`, which was acknowledged or dropped.
    pub fn landed(
        &self,
        vehicle: usize,
        camera: usize,
        id: u64,
        place: usize,
        image: &InFlightImage,
    ) {
        if image.let_go() {
            self.free(vehicle, camera, id, place);
        }
    }

    fn free(&self, vehicle: usize, camera: usize, id: u64, place: usize) {
        if let Some(subscriber) = self.lock().vehicles[vehicle].subscriber(id) {
            subscriber.cameras[camera].taken &= !(1 << place);
        }
        self.changed.notify_all();
    }

    /// Adds a viewer of a vehicle's page until [`Self::viewer_left`].
    pub fn viewer_came(&self, vehicle: usize) {
        self.lock().vehicles[vehicle].viewers += 1;
        self.changed.notify_all();
    }

    /// Removes a viewer.
    pub fn viewer_left(&self, vehicle: usize) {
        let viewers = &mut self.lock().vehicles[vehicle].viewers;
        *viewers = viewers.saturating_sub(1);
    }

    /// Returns the number of viewers of all vehicles.
    pub fn viewers(&self) -> u32 {
        self.lock().vehicles.iter().map(|vehicle| vehicle.viewers).sum()
    }

    /// Returns the vehicles whose pages have viewers.
    pub fn watched(&self) -> [bool; MAX_VEHICLES] {
        let mut watched = [false; MAX_VEHICLES];
        for (watched, vehicle) in watched.iter_mut().zip(&self.lock().vehicles) {
            *watched = vehicle.viewers > 0;
        }
        watched
    }

    /// Waits at most `timeout` for subscribers or viewers; returns their vehicles.
    pub fn wait_for_interest(&self, timeout: Duration) -> [bool; MAX_VEHICLES] {
        let idle = |state: &mut State| {
            !state.closed && !state.vehicles.iter().any(VehicleSubscribers::is_wanted)
        };
        let (state, _) = self
            .changed
            .wait_timeout_while(self.lock(), timeout, idle)
            .unwrap_or_else(PoisonError::into_inner);
        let mut wanted = [false; MAX_VEHICLES];
        for (wanted, vehicle) in wanted.iter_mut().zip(&state.vehicles) {
            *wanted = !state.closed && vehicle.is_wanted();
        }
        wanted
    }

    /// Waits at most `timeout` until an image may be encoded: a subscriber has room, or there are only pages,
    /// which want previews.
    pub fn wait_for_room(&self, timeout: Duration) -> Wanted {
        let deadline = Instant::now() + timeout;
        let mut state = self.lock();
        loop {
            let mut wanted = Wanted::default();
            let vehicles = &state.vehicles;
            wanted.pass_on = vehicles.iter().any(|vehicle| vehicle.viewers > 0)
                && vehicles.iter().all(|vehicle| vehicle.subscribers.is_empty());
            let stamp = clock::now();
            for (index, vehicle) in vehicles.iter().enumerate() {
                for camera in 0..vehicle.cameras {
                    (wanted.fly[index][camera], wanted.stream[index][camera]) =
                        vehicle.room(camera, stamp);
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if state.closed || wanted.anything() || left.is_zero() {
                return if state.closed { Wanted::default() } else { wanted };
            }
            // No notification arrives when a runtime has stalled for long enough.
            let left = if vehicles.iter().any(VehicleSubscribers::has_watcher) {
                left.min(GLANCE)
            } else {
                left
            };
            state =
                self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Ends all present and future waits.
    pub fn shut(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // No code panics while it holds the lock.
        lock(&self.state)
    }
}

/// Maximum of images in flight: 100 ms of round trip at 70 Hz; more would only queue.
pub const MAX_IN_FLIGHT: u32 = 8;
/// Time without room after which a runtime counts as stalled; the transport drops an image after the same time.
/// [s]
const STALLED_S: f64 = 0.15;
/// Maximum delay until a stalled runtime is detected.
const GLANCE: Duration = Duration::from_millis(20);

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::geometry::{Intrinsics, Pose};

    const LONG: Duration = Duration::from_secs(30);
    const NOT_YET: Duration = Duration::from_millis(1);

    fn header(camera: usize) -> ImageHeader {
        let k = Intrinsics::from_horizontal_fov(4, 3, 1.0);
        let body_from_cam = Pose::IDENTITY;
        let pose = ServerTime::ZERO;
        ImageHeader::new(1, camera as u8, pose, &k, &body_from_cam, &Pose::IDENTITY)
    }

    /// Encodes an image of vehicle 0; returns the number of its receivers.
    fn send(subscriptions: &Subscriptions, camera: usize) -> usize {
        let mut broadcast = Broadcast::default();
        subscriptions.begin((0, camera), header(camera), 0, true, &mut broadcast);
        broadcast.push(&Bytes::from_static(b"slice"));
        let count = broadcast.to.len();
        subscriptions.end(&mut broadcast, Some(ServerTime::from_ns(9)));
        count
    }

    #[test]
    fn at_most_k_images_of_each_camera_are_in_flight() {
        let subscriptions = Subscriptions::new(&[2]);
        assert_eq!(subscriptions.wait_for_room(NOT_YET), Wanted::default());
        let places = subscriptions.open(0, 7, Purpose::Fly, 2);
        assert_eq!(
            (send(&subscriptions, 0), send(&subscriptions, 0), send(&subscriptions, 0)),
            (1, 1, 0)
        );
        let wanted = subscriptions.wait_for_room(LONG);
        assert_eq!(wanted.stream[0][..2], [false, true], "camera 1 is not held up by camera 0");
        assert_eq!((send(&subscriptions, 1), send(&subscriptions, 1)), (1, 1));
        assert_eq!(subscriptions.wait_for_room(NOT_YET), Wanted::default());
        subscriptions.landed(0, 0, 7, 1, &places[0][1]);
        assert_eq!(subscriptions.wait_for_room(LONG).stream[0][..2], [true, false]);
        subscriptions.allow(0, 7, 3);
        assert_eq!(subscriptions.wait_for_room(LONG).stream[0][..2], [true, true]);
    }

    #[test]
    fn replaced_session_does_not_affect_the_new_one() {
        let subscriptions = Subscriptions::new(&[1]);
        let old = subscriptions.open(0, 1, Purpose::Fly, 1);
        send(&subscriptions, 0);
        let new = subscriptions.open(0, 2, Purpose::Fly, 1);
        send(&subscriptions, 0);
        subscriptions.landed(0, 0, 1, 0, &old[0][0]);
        subscriptions.close(0, 1);
        assert_eq!(subscriptions.wait_for_room(NOT_YET), Wanted::default());
        subscriptions.landed(0, 0, 2, 0, &new[0][0]);
        assert!(subscriptions.wait_for_room(LONG).stream[0][0]);
        subscriptions.close(0, 2);
        assert_eq!(send(&subscriptions, 0), 0);
    }

    #[tokio::test]
    async fn slices_are_sent_to_all_while_the_image_is_being_encoded() {
        let subscriptions = Subscriptions::new(&[1]);
        let places = [(1, Purpose::Fly), (2, Purpose::Watch), (3, Purpose::Watch)]
            .map(|(id, purpose)| subscriptions.open(0, id, purpose, 1));
        let mut broadcast = Broadcast::default();
        subscriptions.begin((0, 0), header(0), -3, true, &mut broadcast);
        let slice = Bytes::from(vec![1; 100]);
        broadcast.push(&slice);
        for places in &places {
            assert_eq!(places[0][0].image().await, (header(0), -3));
            let Part::Bytes(bytes) = places[0][0].part().await else { panic!("no bytes") };
            assert_eq!(bytes.as_ptr(), slice.as_ptr(), "not a copy");
        }
        // One subscriber gives up before the end: its slot is free only when the encoder has finished.
        subscriptions.landed(0, 0, 1, 0, &places[0][0][0]);
        assert!(!subscriptions.wait_for_room(NOT_YET).fly[0][0]);
        broadcast.push(&slice);
        subscriptions.end(&mut broadcast, None);
        assert!(subscriptions.wait_for_room(LONG).fly[0][0]);
        assert!(matches!(places[1][0][0].part().await, Part::Bytes(_)));
        assert_eq!(places[1][0][0].part().await, Part::Cut);
    }

    #[tokio::test(start_paused = true)]
    async fn watchers_get_the_runtimes_images_unless_it_has_stalled() {
        let subscriptions = Subscriptions::new(&[1]);
        let watcher = subscriptions.open(0, 2, Purpose::Watch, 1);
        let wanted = subscriptions.wait_for_room(LONG);
        assert!(wanted.stream[0][0] && !wanted.fly[0][0], "nobody flies");
        let runtime = subscriptions.open(0, 1, Purpose::Fly, 1);
        assert_eq!(send(&subscriptions, 0), 2);
        // The watcher is slow: the runtime does not wait for it.
        subscriptions.landed(0, 0, 1, 0, &runtime[0][0]);
        assert!(subscriptions.wait_for_room(LONG).fly[0][0]);
        assert_eq!(send(&subscriptions, 0), 1);
        // The runtime is slow: no image is encoded only for the watcher.
        subscriptions.landed(0, 0, 2, 0, &watcher[0][0]);
        assert_eq!(subscriptions.wait_for_room(NOT_YET), Wanted::default());
        tokio::time::advance(Duration::from_millis(200)).await;
        let wanted = subscriptions.wait_for_room(LONG);
        assert!(wanted.stream[0][0] && !wanted.fly[0][0]);
        assert_eq!(send(&subscriptions, 0), 1);
    }

    #[test]
    fn ticks_pass_to_a_page_directly_unless_a_session_exists() {
        let subscriptions = Subscriptions::new(&[1]);
        assert!(!subscriptions.wait_for_interest(NOT_YET)[0]);
        subscriptions.viewer_came(0);
        assert!(subscriptions.wait_for_interest(LONG)[0]);
        assert!(subscriptions.wait_for_room(LONG).pass_on && subscriptions.watched()[0]);
        let places = subscriptions.open(0, 1, Purpose::Fly, 0);
        assert_eq!(
            subscriptions.wait_for_room(NOT_YET),
            Wanted::default(),
            "no room, and no ticks lost"
        );
        drop(places);
        subscriptions.close(0, 1);
        assert!(subscriptions.wait_for_room(LONG).pass_on);
        subscriptions.viewer_left(0);
        assert_eq!(subscriptions.wait_for_room(NOT_YET), Wanted::default());
        subscriptions.viewer_came(0);
        subscriptions.shut();
        assert!(!subscriptions.wait_for_interest(LONG)[0]);
        assert_eq!(subscriptions.wait_for_room(LONG), Wanted::default());
    }
}
