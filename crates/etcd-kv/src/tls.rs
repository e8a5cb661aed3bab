//! Encrypted connections to etcd. Without the feature `tls`, asking for one is an error.

use std::path::PathBuf;

/// Certificates, as PEM files.
#[derive(Clone, Debug, Default)]
pub struct Tls {
    /// The certificates of the authority that signed etcd's certificate.
    pub ca: Option<PathBuf>,
    /// This computer's certificate.
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
        fs::{File, Metadata},
        io::{self, Read as _},
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

    /// How much of a certificate file is read, in bytes.
    const FILE_BYTES_MAX: u64 = 1 << 20;

    /// TLS settings that all connections share.
    #[derive(Clone, Debug)]
    pub(crate) struct TlsSettings {
        files: Tls,
        read: Arc<Mutex<Read>>,
    }

    /// The certificates that were read, and the versions of their files.
    #[derive(Debug)]
    struct Read {
        config: Arc<ClientConfig>,
        stamps: Vec<Option<Stamp>>,
        /// The versions of the files that could not be used, so that the problem is logged only once.
        refused: Vec<Option<Stamp>>,
    }

    /// Identifies a version of a file: inode, and modification time in seconds and nanoseconds.
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

    /// The TLS settings for one endpoint.
    #[derive(Debug)]
    pub(crate) struct Secured(TlsSettings, ServerName<'static>);

    impl Tls {
        /// Reads the certificates. `None` if none are configured.
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
            // `/dev/zero` never ends.
            let open = |path: &PathBuf| {
                let file = File::open(path).map_err(|error| refused(path, error.to_string()))?;
                Ok(file.take(FILE_BYTES_MAX))
            };
            let certificates = |path: &PathBuf| {
                let read = CertificateDer::pem_reader_iter(open(path)?);
                let read: Vec<CertificateDer<'static>> = read
                    .collect::<Result<_, _>>()
                    .map_err(|error| refused(path, error.to_string()))?;
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
                    let private = PrivateKeyDer::from_pem_reader(open(key)?)
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
        /// The present TLS configuration. Files are read again when they change, because certificates are replaced
        /// while rosrescue runs.
        fn config(&self) -> Arc<ClientConfig> {
            let mut read = self.read.lock().unwrap_or_else(PoisonError::into_inner);
            let stamps = self.files.stamps();
            if stamps != read.stamps {
                match self.files.read() {
                    Ok(Some(config)) => *read = Read::new(config, stamps),
                    Ok(None) => {}
                    // A file may be half written at this moment. The next connection reads it again.
                    Err(error) if stamps != read.refused => {
                        tracing::warn!(%error, "cannot use the new certificates for etcd; the old ones stay in use");
                        read.refused = stamps;
                    }
                    Err(_) => {}
                }
            }
            read.config.clone()
        }
    }

    impl Secured {
        /// Creates the settings for `host`. `None` if `host` is not a valid host name.
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
