//! Pairs the simulated lab's server and runtime: the same files that pairing by hand writes, in a folder that
//! ends with the flight.

use std::ffi::OsString;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;

use anyhow::{Context, Result};
use tempfile::TempDir;
use vizflyt_trust::{Client, Identity, KeysFolder, KnownServer, Owner, Paired, Role, Servers};

/// The folder and who is in it.
pub(crate) struct Keys {
    folder: KeysFolder,
    server: Identity,
    scratch: TempDir,
}

impl Keys {
    /// Makes both identities, and gives the runtime the vehicle.
    pub(crate) fn make() -> Result<Self> {
        let scratch = tempfile::Builder::new()
            .prefix("vizflyt-keys-")
            .permissions(Permissions::from_mode(0o700))
            .tempdir()
            .context("cannot make a folder for its keys")?;
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

    /// Returns the option that gives a child this folder.
    pub(crate) fn option(&self) -> OsString {
        let mut option = OsString::from("--keys=");
        option.push(self.scratch.path().join("keys"));
        option
    }

    /// Notes the server's address for the runtime, once it is known.
    pub(crate) fn note_server(&self, address: &str) -> Result<()> {
        let fingerprint = self.server.fingerprint();
        Servers::add(&self.folder, KnownServer { address: address.to_owned(), fingerprint })?;
        Ok(())
    }
}

/// The default name of the vehicle, for server and runtime.
const VEHICLE: &str = "vizflyt";
