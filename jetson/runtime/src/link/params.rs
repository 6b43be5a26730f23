//! Reads and writes parameters of the autopilot: each request is repeated until it is answered, and a value counts as
//! written when the autopilot confirms it.

use std::collections::{BTreeMap, VecDeque};

use vizflyt_protocol::mavlink::dialect::{MavParamType, PARAM_VALUE_DATA};
use vizflyt_protocol::time::HostTime;

use super::dialect::Dialect;

/// Parameter as reported by the autopilot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Param {
    pub value: f64,
    /// Type on the wire.
    pub kind: MavParamType,
}

/// Result of reading or writing.
#[derive(Clone, Debug, PartialEq)]
pub enum ParamEvent {
    /// All requested parameters have been read, or remained unanswered.
    Read {
        /// Names without a reply; the autopilot does not have them.
        missing: Vec<String>,
        /// Number of parameters of a complete list that never arrived.
        lost: usize,
    },
    /// The autopilot has stored the value.
    Written {
        name: String,
        /// Confirmed value.
        value: f64,
    },
    /// The autopilot kept another value, or does not reply.
    NotWritten {
        name: String,
        /// Requested value.
        asked: f64,
        /// Value of the autopilot; `None` without a reply.
        has: Option<f64>,
    },
}

/// Request to send.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Request {
    List,
    ByIndex(u16),
    ByName(String),
    Set { name: String, value: f64, kind: MavParamType },
}

/// Timeout of a request, after which it is repeated. [s]
const REPEAT_S: f64 = 0.5;
/// Maximum pause in a list; parameters that are missing then have been lost. [s]
const LIST_PAUSE_S: f64 = 1.0;
/// Number of attempts, after which the autopilot counts as not having the parameter.
const TRIES: u8 = 5;
/// Maximum number of pending requests; the buffers of a serial link hold as many replies.
const WINDOW: usize = 8;
/// Maximum number of stored values; ArduCopter has about 1400.
const MAX_PARAMS: usize = 4096;

#[derive(Clone, Debug)]
enum ParamKey {
    Index(u16),
    Name(String),
}

#[derive(Clone, Debug)]
struct PendingRead {
    key: ParamKey,
    tries: u8,
    due_at: HostTime,
    /// A later request was answered: the autopilot may not have this parameter.
    is_overtaken: bool,
}

#[derive(Clone, Debug)]
struct Writing {
    name: String,
    value: f64,
    tries: u8,
    due_at: HostTime,
}

/// List in progress.
#[derive(Clone, Debug)]
struct List {
    got: Vec<bool>,
    tries: u8,
    due_at: HostTime,
}

/// Reader and writer of parameters.
#[derive(Clone, Debug, Default)]
pub(super) struct Params {
    known: BTreeMap<String, Param>,
    list: Option<List>,
    queue: VecDeque<ParamKey>,
    asked: Vec<PendingRead>,
    writes: VecDeque<(String, f64)>,
    writing: Option<Writing>,
    missing: Vec<String>,
    lost: usize,
    /// A request has not been reported yet.
    open: bool,
}

impl Params {
    /// Returns the values read so far, by name.
    pub(super) fn known(&self) -> &BTreeMap<String, Param> {
        &self.known
    }

    /// Drops all values and pending requests, for example after a restart.
    pub(super) fn forget(&mut self) {
        *self = Self::default();
    }

    /// Reads the whole list.
    pub(super) fn read_all(&mut self, now: HostTime) {
        self.list = Some(List { got: Vec::new(), tries: 0, due_at: now });
        (self.open, self.lost) = (true, 0);
    }

    /// Reads parameters by name.
    pub(super) fn read(&mut self, names: &[&str]) {
        self.queue.extend(names.iter().map(|&name| ParamKey::Name(name.to_owned())));
        self.open = true;
    }

    /// Writes a parameter; reads it first if its type is unknown.
    pub(super) fn write(&mut self, name: &str, value: f64) {
        self.writes.push_back((name.to_owned(), value));
    }

    /// Whether reading or writing is in progress.
    pub(super) fn is_busy(&self) -> bool {
        self.open || !self.writes.is_empty() || self.writing.is_some()
    }

    /// Whether parameters occupy the link. Repeated requests for names that the autopilot may not have, two a second,
    /// do not.
    pub(super) fn is_talking(&self) -> bool {
        self.list.is_some()
            || !self.queue.is_empty()
            || self.asked.iter().any(|asked| !asked.is_overtaken)
            || !self.writes.is_empty()
            || self.writing.is_some()
    }

    /// Handles a value; returns the event that it completes.
    pub(super) fn handle(
        &mut self,
        now: HostTime,
        message: &PARAM_VALUE_DATA,
        dialect: &dyn Dialect,
    ) -> Option<ParamEvent> {
        let name = message.param_id.to_str().ok().filter(|name| !name.is_empty())?.to_owned();
        let value = dialect.value_from_wire(message.param_value, message.param_type);
        if !value.is_finite() || (self.known.len() >= MAX_PARAMS && !self.known.contains_key(&name))
        {
            return None;
        }
        let param = Param { value, kind: message.param_type };
        self.known.insert(name.clone(), param);
        self.note(now, message.param_index, message.param_count);
        let is_answered = |asked: &PendingRead| match &asked.key {
            ParamKey::Name(key) => *key == name,
            ParamKey::Index(index) => *index == message.param_index,
        };
        let answered = self.asked.iter().rposition(is_answered).unwrap_or(0);
        for earlier in &mut self.asked[..answered] {
            earlier.is_overtaken = true;
        }
        self.asked.retain(|asked| !is_answered(asked));
        let writing = self.writing.as_mut().filter(|writing| writing.name == name)?;
        if same(value, writing.value) {
            self.writing = None;
            return Some(ParamEvent::Written { name, value });
        }
        // Clamped or rejected: retry, because it may be the reply to an earlier request.
        writing.due_at = writing.due_at.min(now.plus_seconds(0.1));
        None
    }

    /// Marks an entry of the list as received.
    fn note(&mut self, now: HostTime, index: u16, count: u16) {
        let Some(list) = &mut self.list else { return };
        if list.got.is_empty() && count > 0 && usize::from(count) <= MAX_PARAMS {
            list.got = vec![false; usize::from(count)];
        }
        if let Some(got) = list.got.get_mut(usize::from(index)) {
            *got = true;
            list.due_at = now.plus_seconds(LIST_PAUSE_S);
        }
    }

    /// Returns the time at which [`Self::poll`] is due next.
    pub(super) fn due_at(&self) -> Option<HostTime> {
        let list = self.list.as_ref().map(|list| list.due_at);
        let writing = self.writing.as_ref().map(|writing| writing.due_at);
        let asked = self.asked.iter().map(|asked| asked.due_at);
        asked.chain(list).chain(writing).min_by(|a, b| a.as_ns().cmp(&b.as_ns()))
    }

    /// Runs what is due: passes requests to `send`, returns a completed event.
    pub(super) fn poll(
        &mut self,
        now: HostTime,
        mut send: impl FnMut(Request),
    ) -> Option<ParamEvent> {
        self.poll_list(now, &mut send);
        self.poll_asked(now, &mut send);
        let idle = self.list.is_none() && self.queue.is_empty() && self.asked.is_empty();
        if self.open && idle {
            self.open = false;
            let missing = std::mem::take(&mut self.missing);
            return Some(ParamEvent::Read { missing, lost: std::mem::take(&mut self.lost) });
        }
        if idle { self.poll_write(now, &mut send) } else { None }
    }

    fn poll_list(&mut self, now: HostTime, send: &mut impl FnMut(Request)) {
        let Some(list) = &mut self.list else { return };
        let complete = !list.got.is_empty() && list.got.iter().all(|&got| got);
        if complete {
            self.list = None;
            return;
        }
        if now < list.due_at {
            return;
        }
        if list.got.is_empty() && list.tries < TRIES {
            list.tries += 1;
            list.due_at = now.plus_seconds(2.0 * LIST_PAUSE_S);
            return send(Request::List);
        }
        // Request the missing entries one by one.
        let holes = list.got.iter().enumerate().filter(|(_, got)| !**got);
        self.queue.extend(holes.map(|(index, _)| ParamKey::Index(index as u16)));
        if list.got.is_empty() {
            self.lost += 1;
        }
        self.list = None;
    }

    fn poll_asked(&mut self, now: HostTime, send: &mut impl FnMut(Request)) {
        if self.list.is_some() {
            return;
        }
        let (mut missing, mut lost) = (Vec::new(), 0);
        self.asked.retain_mut(|asked| {
            if now < asked.due_at {
                return true;
            }
            if asked.tries >= TRIES {
                match &asked.key {
                    ParamKey::Name(name) => missing.push(name.clone()),
                    ParamKey::Index(_) => lost += 1,
                }
                return false;
            }
            asked.tries += 1;
            asked.due_at = now.plus_seconds(REPEAT_S);
            send(request(&asked.key));
            true
        });
        self.missing.append(&mut missing);
        self.lost += lost;
        while self.asked.len() < WINDOW
            && let Some(key) = self.queue.pop_front()
        {
            send(request(&key));
            let due_at = now.plus_seconds(REPEAT_S);
            self.asked.push(PendingRead { key, tries: 1, due_at, is_overtaken: false });
        }
    }

    fn poll_write(&mut self, now: HostTime, send: &mut impl FnMut(Request)) -> Option<ParamEvent> {
        if self.writing.is_none() {
            let (name, value) = self.writes.pop_front()?;
            self.writing = Some(Writing { name, value, tries: 0, due_at: now });
        }
        let writing = self.writing.as_mut().filter(|writing| now >= writing.due_at)?;
        let known = self.known.get(&writing.name).copied();
        if writing.tries >= TRIES {
            let Writing { name, value, .. } = self.writing.take()?;
            return Some(ParamEvent::NotWritten {
                name,
                asked: value,
                has: known.map(|p| p.value),
            });
        }
        writing.tries += 1;
        writing.due_at = now.plus_seconds(REPEAT_S);
        send(match known {
            Some(known) => {
                let kind = known.kind;
                Request::Set { name: writing.name.clone(), value: writing.value, kind }
            }
            // The encoding of the value depends on the type.
            None => Request::ByName(writing.name.clone()),
        });
        None
    }
}

fn request(key: &ParamKey) -> Request {
    match key {
        ParamKey::Index(index) => Request::ByIndex(*index),
        ParamKey::Name(name) => Request::ByName(name.clone()),
    }
}

/// Whether two values are equal within the precision of a float on the wire.
pub fn same(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-5 * a.abs().max(b.abs()).max(1e-3)
}

#[cfg(test)]
mod tests {
    use super::super::dialect::ArduCopter;
    use super::*;

    const NAMES: [&str; 40] = {
        let mut names = [""; 40];
        let mut i = 0;
        while i < 40 {
            names[i] = ["A", "B", "C", "D", "E", "F", "G", "H", "I", "J"][i % 10];
            i += 1;
        }
        names
    };

    /// Autopilot with 40 parameters on a line that loses every `loses`-th reply.
    struct LossyLink {
        params: Params,
        now: HostTime,
        values: Vec<(String, f32)>,
        loses: usize,
        answers: usize,
        max: f32,
        events: Vec<ParamEvent>,
    }

    impl LossyLink {
        fn new(loses: usize) -> Self {
            let name = |(i, n): (usize, &&str)| (format!("{n}_{i}"), i as f32);
            let values = NAMES.iter().enumerate().map(name).collect();
            let (params, now) = (Params::default(), HostTime::from_ns(1_000_000_000));
            Self { params, now, values, loses, answers: 0, max: 100.0, events: Vec::new() }
        }

        fn answer(&mut self, index: usize, reported_index: u16) {
            self.answers += 1;
            if self.loses > 0 && self.answers.is_multiple_of(self.loses) {
                return;
            }
            let (name, value) = &self.values[index];
            let message = PARAM_VALUE_DATA {
                param_value: *value,
                param_count: self.values.len() as u16,
                param_index: reported_index,
                param_id: name.as_str().into(),
                param_type: MavParamType::MAV_PARAM_TYPE_REAL32,
            };
            let event = self.params.handle(self.now, &message, &ArduCopter);
            self.events.extend(event);
        }

        fn run(&mut self, seconds: f64) {
            for _ in 0..(seconds * 50.0) as usize {
                self.now = self.now.plus_seconds(0.02);
                let mut requests = Vec::new();
                let event = self.params.poll(self.now, |request| requests.push(request));
                self.events.extend(event);
                for request in requests {
                    let find = |name: &str| self.values.iter().position(|(n, _)| n == name);
                    match request {
                        Request::List => {
                            for index in 0..self.values.len() {
                                self.answer(index, index as u16);
                            }
                        }
                        Request::ByIndex(index) => self.answer(usize::from(index), index),
                        // ArduCopter replies to a name without the index.
                        Request::ByName(name) => {
                            if let Some(index) = find(&name) {
                                self.answer(index, u16::MAX);
                            }
                        }
                        Request::Set { name, value, .. } => {
                            if let Some(index) = find(&name) {
                                self.values[index].1 = (value as f32).min(self.max);
                                self.answer(index, u16::MAX);
                            }
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn list_is_read_completely_despite_loss() {
        for loses in [0, 2, 3, 7] {
            let mut line = LossyLink::new(loses);
            line.params.read_all(line.now);
            line.run(20.0);
            assert_eq!(line.events, [ParamEvent::Read { missing: vec![], lost: 0 }], "{loses}");
            assert_eq!(line.params.known().len(), 40);
            assert!(!line.params.is_busy());
        }
    }

    #[test]
    fn reports_names_that_do_not_exist() {
        let mut line = LossyLink::new(2);
        line.params.read(&["A_0", "NO_SUCH", "C_2"]);
        line.run(5.0);
        let missing = vec!["NO_SUCH".to_owned()];
        assert_eq!(line.events, [ParamEvent::Read { missing, lost: 0 }]);
        assert_eq!(line.params.known()["C_2"].value, 2.0);
    }

    #[test]
    fn silence_ends_a_read() {
        let mut line = LossyLink::new(1);
        line.params.read_all(line.now);
        line.run(30.0);
        assert_eq!(line.events, [ParamEvent::Read { missing: vec![], lost: 1 }]);
    }

    #[test]
    fn value_is_written_when_the_autopilot_confirms_it() {
        let mut line = LossyLink::new(2);
        line.params.write("B_1", 0.3);
        line.params.write("C_2", 500.0);
        line.params.write("NO_SUCH", 1.0);
        line.run(20.0);
        let not_written =
            |name: &str, asked, has| ParamEvent::NotWritten { name: name.to_owned(), asked, has };
        let [first, second, third] = &line.events[..] else { panic!("{:?}", line.events) };
        assert!(matches!(first, ParamEvent::Written { name, value }
            if name == "B_1" && same(*value, 0.3)));
        assert_eq!(*second, not_written("C_2", 500.0, Some(100.0)), "clamped");
        assert_eq!(*third, not_written("NO_SUCH", 1.0, None));
    }
}
