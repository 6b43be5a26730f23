//! Authorization: this server's identity, and the rights of paired clients.
//!
//! `paired.toml` is read again whenever it changes, so that removing an entry ends that client's right and its
//! connection. If the file cannot be read, the previous rights stay in effect: an editing error must not stop a
//! flight.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::sync::watch;
use tokio::time::{MissedTickBehavior, interval};
use tracing::{info, warn};
use vizflyt_protocol::messages::{Grant, MAX_GRANTED, PairingRequest, PairingShare, bounded};
use vizflyt_trust::pairing::{
    Admitted, Attempt, Binding, Code, PairingServer, Refusal, WindowState,
};
use vizflyt_trust::{Client, Fingerprint, Identity, KeyError, KeysFolder, Owner, Paired};

use vizflyt_process::lock;

/// Identity, rights and pairing of the server.
#[derive(Debug)]
pub struct Authorizer {
    pub identity: Identity,
    /// Folder of keys and of `paired.toml`.
    pub folder: KeysFolder,
    paired: watch::Sender<Arc<Paired>>,
    desk: Mutex<PairingServer>,
    /// Result of the newest pairing attempt.
    pairing_news: watch::Sender<String>,
}

impl Authorizer {
    /// Opens the keys folder; creates this server's identity at its first start.
    ///
    /// # Errors
    /// Keys or a `paired.toml` that cannot be used.
    pub fn open(folder: KeysFolder) -> Result<Self, KeyError> {
        let identity = Identity::load_or_create(&folder, Owner::Server)?;
        let paired = watch::Sender::new(Arc::new(Paired::read(&folder)?));
        let (desk, pairing_news) = (Mutex::default(), watch::Sender::default());
        Ok(Self { identity, folder, paired, desk, pairing_news })
    }

    /// Returns all paired clients.
    pub fn paired(&self) -> Arc<Paired> {
        self.paired.borrow().clone()
    }

    /// Returns the paired client with this fingerprint.
    pub fn client(&self, fingerprint: Fingerprint) -> Option<Client> {
        self.paired.borrow().client(fingerprint).cloned()
    }

    /// Completes when a client may no longer use a vehicle.
    pub async fn right_ends(&self, fingerprint: Fingerprint, vehicle: &str) {
        let mut paired = self.paired.subscribe();
        let lost = |paired: &Arc<Paired>| {
            !paired.client(fingerprint).is_some_and(|client| client.may_use(vehicle))
        };
        // An error would mean that the sender is dropped, but `self` holds it.
        let _ = paired.wait_for(lost).await;
    }

    /// Opens a pairing window with a new code.
    ///
    /// # Errors
    /// A window is open already, or there are no random numbers.
    pub fn open_pairing(&self, grant: Grant) -> Result<WindowState, String> {
        let code = Code::random()?;
        let now = Instant::now();
        let mut desk = lock(&self.desk);
        if !desk.open(now, code, grant) {
            return Err("a pairing is open already; use its code, or close it".to_owned());
        }
        self.pairing_news.send_replace("waiting for the code".to_owned());
        desk.state(now).ok_or_else(|| "the pairing closed at once".to_owned())
    }

    /// Returns the open pairing window.
    pub fn pairing(&self) -> Option<WindowState> {
        lock(&self.desk).state(Instant::now())
    }

    /// Closes the pairing window.
    pub fn shut_pairing(&self) {
        lock(&self.desk).shut();
        self.pairing_news.send_replace("closed".to_owned());
    }

    /// Returns a receiver of the results of pairing attempts; newest wins.
    pub fn pairing_news(&self) -> watch::Receiver<String> {
        self.pairing_news.subscribe()
    }

    /// Returns the result of the newest pairing attempt.
    pub fn newest_pairing_news(&self) -> String {
        self.pairing_news.borrow().clone()
    }

    /// Processes the first message of a client that requests pairing.
    ///
    /// # Errors
    /// Reason of the refusal.
    pub fn begin_pairing(
        &self,
        message: &PairingRequest,
        binding: &Binding,
    ) -> Result<(Attempt, PairingShare), Refusal> {
        lock(&self.desk).begin(Instant::now(), message, binding)
    }

    /// Verifies the client's proof, and pairs it if the proof is right.
    ///
    /// # Errors
    /// Reason of the refusal, for the user.
    pub fn confirm_pairing(
        &self,
        attempt: Attempt,
        message: &PairingRequest,
        from: SocketAddr,
    ) -> Result<Admitted, String> {
        let admitted = lock(&self.desk).confirm(Instant::now(), attempt, message);
        let admitted = admitted.map_err(|refusal| {
            self.pairing_news.send_replace(format!("{from}: {refusal}"));
            refusal.to_string()
        })?;
        match Paired::add(&self.folder, admitted.client.clone()) {
            Ok(paired) => {
                self.paired.send_replace(Arc::new(paired));
                self.pairing_news.send_replace(format!("'{}' is paired", admitted.client.name));
                Ok(admitted)
            }
            Err(error) => {
                warn!("{error}");
                self.pairing_news.send_replace(error.to_string());
                Err("the server could not store the pairing; see its log".to_owned())
            }
        }
    }

    /// Monitors `paired.toml`; never returns.
    pub async fn follow(&self) {
        let mut tick = interval(LOOK_EVERY);
        tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut taken = self.folder.stamp(Paired::FILE);
        let mut seen = taken;
        loop {
            tick.tick().await;
            let found = self.folder.stamp(Paired::FILE);
            // Two equal stamps are required, so that a file is not read while an editor writes it.
            if found == seen && found != taken {
                taken = found;
                self.reread();
            }
            seen = found;
        }
    }

    fn reread(&self) {
        match Paired::read(&self.folder) {
            Ok(paired) => {
                let changed = self.paired.send_if_modified(|known| {
                    let changes = **known != paired;
                    *known = Arc::new(paired);
                    changes
                });
                if changed {
                    info!("paired.toml has changed: {} paired", self.paired().clients.len());
                }
            }
            Err(error) => {
                warn!("{error}; the previous rights stay in effect until the file is corrected");
            }
        }
    }
}

/// Interval of checks; a removed entry takes effect after two of them.
const LOOK_EVERY: Duration = Duration::from_millis(250);

/// Parses `instructor` or `team:VEHICLE[,VEHICLE...]`.
pub(crate) fn parse_grant(text: &str) -> Result<Grant, String> {
    if text == "instructor" {
        return Ok(Grant::Instructor);
    }
    let names = text.strip_prefix("team:").ok_or("write instructor, or team:VEHICLE")?;
    let mut vehicles = heapless::Vec::new();
    for name in names.split(',') {
        if name.is_empty() || name.len() > 32 || name.chars().any(char::is_control) {
            return Err(format!("'{name}' is not a valid vehicle name (1 to 32 bytes of text)"));
        }
        if vehicles.push(bounded(name)).is_err() {
            return Err(format!("a team has at most {MAX_GRANTED} vehicles"));
        }
    }
    Ok(Grant::Team { vehicles })
}

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_trust::Role;

    fn client(name: &str, vehicle: &str) -> Client {
        Client {
            name: name.to_owned(),
            fingerprint: Fingerprint::of(name.as_bytes()),
            role: Role::Team,
            vehicles: vec![vehicle.to_owned()],
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_right_ends_with_its_entry_but_not_with_an_invalid_file() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        Paired::add(&folder, client("ants", "ant")).unwrap();
        let authorizer = Arc::new(Authorizer::open(folder.clone()).unwrap());
        let following = tokio::spawn({
            let authorizer = authorizer.clone();
            async move { authorizer.follow().await }
        });
        let print = Fingerprint::of(b"ants");
        let ending = tokio::spawn({
            let authorizer = authorizer.clone();
            async move { authorizer.right_ends(print, "ant").await }
        });
        // Another team's vehicle: the client never had this right.
        authorizer.right_ends(print, "bee").await;

        let good = folder.read(Paired::FILE).unwrap().unwrap();
        folder.write(Paired::FILE, "[[client]").unwrap();
        tokio::time::sleep(8 * LOOK_EVERY).await;
        assert!(!ending.is_finished() && authorizer.client(print).is_some());
        folder.write(Paired::FILE, &good.replace("\"ant\"", "\"ant\", \"bee\"")).unwrap();
        tokio::time::sleep(8 * LOOK_EVERY).await;
        assert!(!ending.is_finished() && authorizer.client(print).unwrap().may_use("bee"));
        folder.write(Paired::FILE, "").unwrap();
        ending.await.unwrap();
        assert_eq!(authorizer.client(print), None);
        following.abort();
    }
}
