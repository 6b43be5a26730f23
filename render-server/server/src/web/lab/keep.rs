//! The lab day and its file: read at the start, written completely after each change, so that a restart loses nothing.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{SystemTime, UNIX_EPOCH};

use tokio::task::JoinHandle;
use tracing::warn;
use vizflyt_protocol::time::Civil;

use super::guided::Guided;
use crate::flights::Flights;
use crate::flights::lab_day::{CheckId, Finding, LabDay, Stand};
use crate::flights::vehicle::VehicleFlight;
use crate::poses::settings::LocalizationConfig;
use vizflyt_process::lock;

#[derive(Debug)]
pub(crate) struct Lab {
    day: Mutex<LabDay>,
    /// File of the day; `None` keeps it in memory only.
    file: Option<PathBuf>,
    /// Serializes writers, so that the newest state is written last.
    writing: Mutex<()>,
    is_changed: AtomicBool,
    /// The running check of axes.
    pub(in crate::web) guided: Mutex<Option<Guided>>,
    /// First source of poses; its settings are the subject of that check.
    pub(in crate::web) source: Option<LocalizationConfig>,
}

impl Lab {
    /// Opens the day of `file`, or begins one. A file that cannot be read is renamed.
    pub(crate) fn open(file: Option<PathBuf>, source: Option<LocalizationConfig>) -> Self {
        let day = file.as_deref().and_then(read);
        Self {
            day: Mutex::new(day.unwrap_or_else(|| LabDay::new(unix_ms()))),
            file,
            writing: Mutex::default(),
            is_changed: AtomicBool::new(false),
            guided: Mutex::default(),
            source,
        }
    }

    /// Reads the day.
    pub(in crate::web) fn look<T>(&self, look: impl FnOnce(&LabDay) -> T) -> T {
        look(&lock(&self.day))
    }

    /// Changes the day; `change` gets the time, ms since 1970. The next [`Self::keep`] writes it.
    pub(in crate::web) fn change<T>(&self, change: impl FnOnce(&mut LabDay, u64) -> T) -> T {
        let mut day = lock(&self.day);
        // While the day is locked: a writer that clears this flag then reads the change.
        self.is_changed.store(true, Ordering::Relaxed);
        change(&mut day, unix_ms())
    }

    /// Records repeated measurements of the server. Only a changed finding is written before the server stops.
    pub(in crate::web) fn measured(&self, vehicle: &str, check: CheckId, finding: Finding) {
        let is_news = lock(&self.day).record(vehicle, check, finding, "the server", unix_ms());
        self.is_changed.fetch_or(is_news, Ordering::Relaxed);
    }

    /// Writes everything, when the server stops.
    pub(crate) fn close(&self) {
        self.is_changed.store(true, Ordering::Relaxed);
        // `keep` has logged the error.
        let _ = self.keep();
    }

    /// Checks whether a vehicle may take off, by the order of take-off.
    ///
    /// # Errors
    /// Reason, and what to do.
    pub(crate) fn may_start(&self, flights: &Flights, vehicle: &str) -> Result<(), String> {
        let stand =
            |name: &str| flights.vehicle(name).map_or(Stand::Below, |vehicle| stand(vehicle));
        self.look(|day| day.order.may_start(vehicle, stand))
    }

    /// Writes changes; returns when they are on the disk.
    ///
    /// # Errors
    /// If writing fails; the next call retries.
    pub(crate) fn keep(&self) -> io::Result<()> {
        let Some(file) = &self.file else { return Ok(()) };
        let _one = lock(&self.writing);
        if !self.is_changed.swap(false, Ordering::Relaxed) {
            return Ok(());
        }
        let bytes = self.look(LabDay::to_bytes);
        write(file, &bytes).inspect_err(|error| {
            self.is_changed.store(true, Ordering::Relaxed);
            warn!("the lab day is not kept: {}: {error}", file.display());
        })
    }

    /// Begins another day; the old file is kept with its date in its name.
    pub(in crate::web) fn begin_anew(&self, by: &str) {
        // `keep` has logged the error, and the new day replaces the old one.
        let _ = self.keep();
        let began_unix_ms = self.look(|day| day.began_unix_ms);
        if let Some(file) = &self.file {
            let Civil { year, month, day, hour, minute, second } =
                Civil::of_unix(began_unix_ms / 1000);
            let name =
                format!("lab-day-{year:04}{month:02}{day:02}-{hour:02}{minute:02}{second:02}.json");
            if let Err(error) = fs::rename(file, file.with_file_name(name)) {
                warn!("the former lab day is not set aside: {}: {error}", file.display());
            }
        }
        self.change(|day, now_unix_ms| {
            // These settings belong to the room, not to the day.
            let (order, separation_m) = (std::mem::take(&mut day.order), day.separation_m);
            *day = LabDay::new(now_unix_ms);
            (day.order, day.separation_m) = (order, separation_m);
            day.tell(format!("the day begins, by {by}"), now_unix_ms);
        });
    }
}

/// Returns the stage of a vehicle's flight in the order of take-off.
pub(in crate::web) fn stand(vehicle: &VehicleFlight) -> Stand {
    use vizflyt_protocol::messages::FlightPhase::TakingOff;
    let flight = vehicle.flight();
    match flight.took_off {
        Some(_) if flight.landed.is_some() => Stand::Landed,
        Some(_) if vehicle.phase() != TakingOff => Stand::Up,
        _ => Stand::Below,
    }
}

/// Returns the wall-clock time. [ms since 1970]
pub(in crate::web) fn unix_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_millis() as u64)
}

fn read(file: &Path) -> Option<LabDay> {
    let bytes = match fs::metadata(file).and_then(|known| {
        if known.len() > MAX_BYTES {
            Err(io::ErrorKind::FileTooLarge.into())
        } else {
            fs::read(file)
        }
    }) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return None,
        Err(error) => {
            set_aside(file, &error.to_string());
            return None;
        }
    };
    LabDay::parse(&bytes).map_err(|error| set_aside(file, &error.to_string())).ok()
}

fn set_aside(file: &Path, why: &str) {
    let aside = file.with_extension("damaged");
    let moved = fs::rename(file, &aside);
    let aside = moved.map_or_else(
        |error| error.to_string(),
        |()| format!("the old file is {}", aside.display()),
    );
    warn!("{}: {why}; a new lab day begins, {aside}", file.display());
}

fn write(file: &Path, bytes: &[u8]) -> io::Result<()> {
    if let Some(folder) = file.parent() {
        fs::create_dir_all(folder)?;
    }
    let beside = file.with_extension("new");
    let mut new = File::create(&beside)?;
    new.write_all(bytes)?;
    new.sync_all()?;
    fs::rename(&beside, file)?;
    // Sync the folder too, so that the new name survives a power cut.
    File::open(
        file.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new(".")),
    )?
    .sync_all()
}

/// Writes in the background, for callers that must not wait for a disk.
#[derive(Debug, Default)]
pub(in crate::web) struct Keeper(Option<JoinHandle<()>>);

impl Keeper {
    /// Begins to write changes, unless a write is still running.
    pub(in crate::web) fn begin(&mut self, lab: &Arc<Lab>) {
        if self.0.as_ref().is_none_or(JoinHandle::is_finished) {
            let lab = lab.clone();
            // `keep` logs errors.
            self.0 = Some(tokio::task::spawn_blocking(move || drop(lab.keep())));
        }
    }
}

/// Maximum size of the file, ten times a full day.
const MAX_BYTES: u64 = 4 << 20;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flights::lab_day::State;

    #[test]
    fn keeps_changes_after_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("deeper/lab-day.json");
        let lab = Lab::open(Some(file.clone()), None);
        lab.change(|day, now| {
            day.record("", CheckId::Net, Finding::of("signed".to_owned(), &[]), "Ada", now)
        });
        lab.change(|day, now| day.queue.book("ants", "wasp", now)).unwrap();
        lab.keep().unwrap();
        let again = Lab::open(Some(file.clone()), None);
        assert_eq!(again.look(Clone::clone), lab.look(Clone::clone));
        assert_eq!(again.look(|day| day.state("", CheckId::Net, unix_ms())), State::Ok);
        // Another day: the file of the previous one is kept.
        again.change(|day, _| day.set_separation(Some(1.5))).unwrap();
        again.begin_anew("Ada");
        again.keep().unwrap();
        let third = Lab::open(Some(file.clone()), None);
        assert_eq!(
            third.look(|day| (day.queue.bookings().len(), day.separation_m)),
            (0, Some(1.5))
        );
        let kept = fs::read_dir(file.parent().unwrap()).unwrap().count();
        assert_eq!(kept, 2, "the new day and the former");
    }

    #[test]
    fn renames_a_damaged_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("lab-day.json");
        fs::write(&file, b"{\"version\": 1").unwrap();
        let lab = Lab::open(Some(file.clone()), None);
        assert_eq!(lab.look(|day| day.queue.bookings().len()), 0);
        assert!(!file.exists() && file.with_extension("damaged").exists());
        lab.change(|day, now| day.tell("go on".to_owned(), now));
        lab.keep().unwrap();
        assert!(file.exists());
    }

    #[test]
    fn reports_and_retries_a_failed_write() {
        let folder = tempfile::tempdir().unwrap();
        let blocked = folder.path().join("full");
        fs::write(&blocked, b"").unwrap();
        let lab = Lab::open(Some(blocked.join("lab-day.json")), None);
        lab.change(|day, now| day.tell("a day".to_owned(), now));
        assert!(lab.keep().is_err() && lab.keep().is_err());
        fs::remove_file(&blocked).unwrap();
        lab.keep().unwrap();
        assert!(blocked.join("lab-day.json").exists());
    }

    #[test]
    fn writes_changes_made_during_another_write() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("lab-day.json");
        let lab = Lab::open(Some(file.clone()), None);
        std::thread::scope(|scope| {
            for who in ["ants", "bees", "cats"] {
                let (lab, file) = (&lab, &file);
                scope.spawn(move || {
                    for n in 0..60 {
                        let text = format!("{who} {n}.");
                        lab.change(|day, now| day.tell(text.clone(), now));
                        lab.keep().unwrap();
                        let kept = fs::read_to_string(file).unwrap();
                        assert!(kept.contains(&text), "{text} is lost");
                    }
                });
            }
        });
    }

    #[tokio::test]
    async fn a_hanging_disk_does_not_block_callers() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("lab-day.json");
        let lab = Arc::new(Lab::open(Some(file.clone()), None));
        lab.change(|day, now| day.tell("a day".to_owned(), now));
        let mut keeper = Keeper::default();
        let stalled = lock(&lab.writing);
        for _ in 0..3 {
            keeper.begin(&lab);
        }
        assert!(!file.exists());
        drop(stalled);
        keeper.0.take().unwrap().await.unwrap();
        assert!(file.exists());
    }
}
