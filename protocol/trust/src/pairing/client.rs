//! Client's side of pairing, with the code that the user typed.

use hmac::{Hmac, Mac};
use sha2::Sha256;
use vizflyt_protocol::messages::{Name, PairingProof, PairingRequest, PairingShare, bounded};

use super::{Agreement, Binding, Code, PairingRole, Transcript, is, start};

/// Client that has sent its share and waits for the server's.
pub struct PairingClient {
    agreement: Agreement,
    binding: Binding,
    name: Name,
    share: PairingShare,
}

/// Client that has sent its proof and waits for the server's.
pub struct Confirming(Hmac<Sha256>);

impl PairingClient {
    /// Starts pairing. Returns the message to send. A name that is too long is truncated.
    pub fn begin(code: Code, name: &str, binding: Binding) -> (Self, PairingRequest) {
        let (agreement, share) = start(PairingRole::A, code);
        let name: Name = bounded(name);
        let message = PairingRequest::Begin { name: name.clone(), share };
        (Self { agreement, binding, name, share }, message)
    }

    /// Processes the server's share. Returns the message to send; `None` if the share is invalid.
    pub fn confirm(self, server_share: &PairingShare) -> Option<(Confirming, PairingRequest)> {
        let transcript = Transcript {
            binding: &self.binding,
            name: &self.name,
            client_share: &self.share,
            server_share,
        };
        let proofs = transcript.prove(PairingRole::A, self.agreement)?;
        let proof = proofs.client.finalize().into_bytes().into();
        Some((Confirming(proofs.server), PairingRequest::Confirm { proof }))
    }
}

impl Confirming {
    /// Whether the server has the same key, and is therefore the server that displayed the code.
    pub fn is_proof(self, proof: &PairingProof) -> bool {
        is(self.0, proof)
    }
}
