//! Encrypted connections to etcd. Without the feature `tls` there are none, and asking for one is an error.

use std::path::PathBuf;

/// Certificates, as files in PEM form.
#[derive(Clone, Debug, Default)]
pub struct Tls {
    /// Those that etcd's certificate is signed with.
    pub ca: Option<PathBuf>,
    /// The certificate of this computer and its key.
    pub cert: Option<PathBuf>,
    pub key: Option<PathBuf>,
}

#[cfg(feature = "tls")]
pub(super) use with::{Secured, TlsSettings};

#[cfg(not(feature = "tls"))]
pub(super) use without::{Secured, TlsSettings};

#[cfg(feature = "tls")]
mod with {
    use std::{
        fs::Metadata,
        io,
        os::unix::fs::MetadataExt,
        path::PathBuf,
        sync::{Arc, Mutex, PoisonError},
    };

    use tokio::net::TcpStream;
    use tokio_rustls::{
        TlsConnector,
        client::TlsStream,
        rustls::{
            ClientConfig, RootCertStore,
            pki_types::{CertificateDer, PrivateKeyDer, ServerName, pem::PemObject},
        },
    };

    use super::Tls;
    use crate::EtcdError;

    /// What all connections share.
    #[derive(Clone, Debug)]
    pub(crate) struct TlsSettings {
        files: Tls,
        read: Arc<Mutex<Read>>,
    }

    /// What was read, and from which files.
    #[derive(Debug)]
    struct Read {
        config: Arc<ClientConfig>,
        stamps: Vec<Option<Stamp>>,
        /// Those of files that could not be used, so that it is logged once.
        refused: Vec<Option<Stamp>>,
    }

    /// Tells a file from the one that was at its place before.
    type Stamp = (u64, i64, i64);

    impl Read {
        fn new(config: Arc<ClientConfig>, stamps: Vec<Option<Stamp>>) -> Self {
            Self {
                config,
                stamps,
                refused: Vec::new(),
            }
        }
    }

    /// How to connect to one endpoint.
    #[derive(Debug)]
    pub(crate) struct Secured(TlsSettings, ServerName<'static>);

    impl Tls {
        /// None without certificates.
        pub(crate) fn settings(&self) -> Result<Option<TlsSettings>, EtcdError> {
            let stamps = self.stamps();
            let Some(config) = self.read()? else {
                return Ok(None);
            };
            Ok(Some(TlsSettings {
                files: self.clone(),
                read: Arc::new(Mutex::new(Read::new(config, stamps))),
            }))
        }

        fn stamps(&self) -> Vec<Option<Stamp>> {
            let stamp = |of: Metadata| (of.ino(), of.mtime(), of.mtime_nsec());
            let files = [&self.ca, &self.cert, &self.key].into_iter().flatten();
            files.map(|file| file.metadata().ok().map(stamp)).collect()
        }

        fn read(&self) -> Result<Option<Arc<ClientConfig>>, EtcdError> {
            let Some(ca) = &self.ca else {
                return Ok(None);
            };
            let refused = |path: &PathBuf, why: String| {
                EtcdError::Options(format!(
                    "the certificate file {} cannot be used: {why}",
                    path.display()
                ))
            };
            let certificates = |path: &PathBuf| {
                let read = CertificateDer::pem_file_iter(path).and_then(Iterator::collect);
                let read: Vec<CertificateDer<'static>> =
                    read.map_err(|error| refused(path, error.to_string()))?;
                match read.is_empty() {
                    true => Err(refused(path, "there is no certificate in it".to_owned())),
                    false => Ok(read),
                }
            };
            let mut roots = RootCertStore::empty();
            for certificate in certificates(ca)? {
                roots
                    .add(certificate)
                    .map_err(|error| refused(ca, error.to_string()))?;
            }
            let builder = ClientConfig::builder().with_root_certificates(roots);
            let config = match (&self.cert, &self.key) {
                (None, None) => builder.with_no_client_auth(),
                (Some(cert), Some(key)) => {
                    let private = PrivateKeyDer::from_pem_file(key)
                        .map_err(|error| refused(key, error.to_string()))?;
                    builder
                        .with_client_auth_cert(certificates(cert)?, private)
                        .map_err(|error| refused(cert, error.to_string()))?
                }
                _ => {
                    let why =
                        "a certificate for this computer needs its key, and a key its certificate";
                    return Err(EtcdError::Options(why.to_owned()));
                }
            };
            Ok(Some(Arc::new(config)))
        }
    }

    impl TlsSettings {
        /// Read again if a file has changed, because an expiring certificate is replaced while rosrescue runs.
        fn config(&self) -> Arc<ClientConfig> {
            let mut read = self.read.lock().unwrap_or_else(PoisonError::into_inner);
            let stamps = self.files.stamps();
            if stamps != read.stamps {
                match self.files.read() {
                    Ok(Some(config)) => *read = Read::new(config, stamps),
                    Ok(None) => {}
                    // It may be only half there.
                    Err(error) if stamps != read.refused => {
                        tracing::warn!(%error, "new certificates for etcd are not used");
                        read.refused = stamps;
                    }
                    Err(_) => {}
                }
            }
            read.config.clone()
        }
    }

    impl Secured {
        /// None if `host` is no name of a host.
        pub(crate) fn new(settings: &TlsSettings, host: &str) -> Option<Self> {
            let name = ServerName::try_from(host.to_owned()).ok()?;
            Some(Self(settings.clone(), name))
        }

        pub(crate) async fn connect(&self, stream: TcpStream) -> io::Result<TlsStream<TcpStream>> {
            let Self(settings, name) = self;
            let connector = TlsConnector::from(settings.config());
            connector.connect(name.clone(), stream).await
        }
    }
}

#[cfg(not(feature = "tls"))]
mod without {
    use std::{convert::Infallible, io};

    use tokio::net::TcpStream;

    use super::Tls;
    use crate::EtcdError;

    #[derive(Clone, Debug)]
    pub(crate) struct TlsSettings(Infallible);

    #[derive(Debug)]
    pub(crate) struct Secured(Infallible);

    impl Tls {
        pub(crate) fn settings(&self) -> Result<Option<TlsSettings>, EtcdError> {
            match &self.ca {
                None => Ok(None),
                Some(_) => Err(EtcdError::Options(
                    "this rosrescue was built without TLS; build it with the feature `tls`, or use \
                     http://"
                        .to_owned(),
                )),
            }
        }
    }

    impl Secured {
        pub(crate) fn new(settings: &TlsSettings, _: &str) -> Option<Self> {
            match settings.0 {}
        }

        pub(crate) async fn connect(&self, _: TcpStream) -> io::Result<TcpStream> {
            match self.0 {}
        }
    }
}
