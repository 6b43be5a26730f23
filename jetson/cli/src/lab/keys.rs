//! Pairs the server and runtime of the simulated lab: writes the same files as `vizflyt pair`, in a
//! folder that is deleted after the flight.

use std::ffi::OsString;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;

use anyhow::{Context, Result};
use tempfile::TempDir;
use vizflyt_trust::{Client, Identity, KeysFolder, KnownServer, Owner, Paired, Role, Servers};

/// Folder of keys.
pub(crate) struct Keys {
    folder: KeysFolder,
    server: Identity,
    scratch: TempDir,
}

impl Keys {
    /// Creates both identities, and gives the runtime the right to fly the vehicle.
    pub(crate) fn make() -> Result<Self> {
        let scratch = tempfile::Builder::new()
            .prefix("vizflyt-keys-")
            .permissions(Permissions::from_mode(0o700))
            .tempdir()
            .context("cannot create a temporary folder for keys")?;
        let folder = KeysFolder::open(Some(&scratch.path().join("keys")))?;
        let server = Identity::load_or_create(&folder, Owner::Server)?;
        let runtime = Identity::load_or_create(&folder, Owner::Runtime)?;
        let client = Client {
            name: "simulated lab".to_owned(),
            fingerprint: runtime.fingerprint(),
            role: Role::Team,
            vehicles: vec![VEHICLE.to_owned()],
        };
        Paired::add(&folder, client)?;
        Ok(Self { folder, server, scratch })
    }

    /// Returns the option that passes this folder to a child.
    pub(crate) fn option(&self) -> OsString {
        let mut option = OsString::from("--keys=");
        option.push(self.scratch.path().join("keys"));
        option
    }

    /// Stores the server's address for the runtime.
    pub(crate) fn note_server(&self, address: &str) -> Result<()> {
        let fingerprint = self.server.fingerprint();
        Servers::add(&self.folder, KnownServer { address: address.to_owned(), fingerprint })?;
        Ok(())
    }
}

/// Default name of the vehicle on server and runtime.
const VEHICLE: &str = "vizflyt";
