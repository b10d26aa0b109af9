//! A certificate authority for tests. Unlike `comic-learner certs` it also makes expired certificates.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use comic_proto::Access;
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair};
use tempfile::TempDir;
use time::{Duration, OffsetDateTime};

/// A certificate authority with its own directory.
pub struct Authority {
    directory: TempDir,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    /// Makes a new authority. Its certificate is `ca.pem`.
    ///
    /// # Errors
    /// When no directory can be made.
    pub fn new() -> Result<Self> {
        let directory = tempfile::tempdir().context("cannot make a directory")?;
        let mut params = CertificateParams::default();
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate()?;
        fs::write(directory.path().join("ca.pem"), params.self_signed(&key)?.pem())?;
        Ok(Self { directory, issuer: Issuer::new(params, key) })
    }

    /// The path of the file `name`.
    pub fn path(&self, name: &str) -> PathBuf {
        self.directory.path().join(name)
    }

    /// Makes `NAME.pem` and `NAME-key.pem`, which replace older ones. They are valid for this number of minutes from now.
    ///
    /// # Errors
    /// When the directory cannot be written.
    pub fn issue(&self, name: &str, minutes: i64) -> Result<()> {
        let mut params = CertificateParams::new(["localhost".to_owned(), "127.0.0.1".to_owned()])?;
        let now = OffsetDateTime::now_utc();
        (params.not_before, params.not_after) = (now - Duration::days(2), now + Duration::minutes(minutes));
        let key = KeyPair::generate()?;
        let certificate = params.signed_by(&key, &self.issuer)?;
        fs::write(self.path(&format!("{name}-key.pem")), key.serialize_pem())?;
        fs::write(self.path(&format!("{name}.pem")), certificate.pem())?;
        Ok(())
    }

    /// Access for a client that trusts this authority and presents its certificate `name`.
    pub fn access(&self, name: Option<&str>) -> Access {
        Access {
            ca: Some(self.path("ca.pem")),
            cert: name.map(|name| self.path(&format!("{name}.pem"))),
            key: name.map(|name| self.path(&format!("{name}-key.pem"))),
            token_file: None,
        }
    }

    /// The learner's options for serving with the certificate `server`.
    pub fn serving(&self) -> Vec<String> {
        let [cert, key] = ["server.pem", "server-key.pem"].map(|name| shown(&self.path(name)));
        vec!["--cert".into(), cert, "--key".into(), key]
    }

    /// The learner's options for asking clients for certificates of this authority.
    pub fn asking(&self) -> Vec<String> {
        vec!["--client-ca".into(), shown(&self.path("ca.pem"))]
    }
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}
