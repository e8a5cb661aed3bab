//! Checks that must hold for any bytes found as a checkpoint.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use checkpoint_store::{FileId, FileStatus, Loaded, Storage, Store};
use rescue_core::checkpoint::{
    format::{self, Checkpoint, Label, Origin, Record, RecordContent},
    session::{Rebuilt, rebuild},
};
use ros1_master::master::{Master, Method, Request};

use super::seal::{position, sealed};

/// Separates the present file from its previous generation, which may follow it.
const PREVIOUS: &[u8] = b"=== previous generation ===\n";

/// Loads the bytes as they are, and again with all check sums corrected.
pub(crate) fn check(bytes: &[u8]) {
    let at = position(bytes, PREVIOUS);
    let (present, previous) = match at {
        Some(at) => (&bytes[..at], Some(&bytes[at + PREVIOUS.len()..])),
        None => (bytes, None),
    };
    load(present, previous);
    load(&sealed(present), previous.map(sealed).as_deref());
}

/// Panics if loading panics, or if the loaded state is not read back after it was written.
fn load(present: &[u8], previous: Option<&[u8]>) {
    if let Ok(decoded) = format::decode(present) {
        decoded.records.iter().for_each(check_record);
    }
    let path = Path::new("/c/latest-chkpt.yaml");
    let memory = Memory::default();
    memory.put(path, present);
    if let Some(previous) = previous {
        memory.put(Path::new("/c/latest-chkpt.yaml.previous"), previous);
    }
    let Ok((mut store, Some(loaded))) = Store::open_on(memory.clone(), path) else {
        return;
    };
    // No store ever counts this far. A state written with a higher number could not be read again.
    const END: u64 = u64::MAX / 2 - 2;
    if store.seq() > END || store.generation() > END {
        return;
    }
    let Loaded {
        checkpoint,
        records,
        ..
    } = loaded;
    let Rebuilt {
        mirror,
        session,
        pending,
        displaced,
        ..
    } = rebuild(checkpoint, records);
    let snapshot = mirror.snapshot();
    assert_eq!(Master::from_snapshot(snapshot.clone()), Ok(mirror));

    let expected = Checkpoint {
        seq: store.seq(),
        session: session.unwrap_or_default(),
        snapshot,
        pending,
        displaced,
        follows: false,
    };
    store
        .begin(&expected)
        .expect("cannot write what was loaded");
    let call = Request::new(Method::DeleteParam, ["/n", "/p"]);
    let entries = [
        RecordContent::Call {
            call,
            pending: true,
            label: Label {
                at: 1_764_115_200_123,
                origin: Origin::Rosrescue,
            },
        },
        RecordContent::Session(expected.session.clone().into()),
    ];
    store.append(&entries).expect("cannot append records to it");
    drop(store);

    let (store, loaded) = Store::open_on(memory, path).expect("cannot open our own file");
    let loaded = loaded.expect("our own file is missing");
    assert!(loaded.exact && loaded.torn.is_none(), "{loaded:?}");
    assert_eq!(loaded.damage, Vec::<String>::new());
    assert_eq!(store.seq(), expected.seq + 2);
    assert_eq!(loaded.checkpoint, Some(expected));
    let found: Vec<_> = loaded.records.into_iter().map(|it| it.entry).collect();
    assert_eq!(found, entries);
}

fn check_record(record: &Record) {
    // An entry that cannot be run is written as nil.
    if matches!(&record.entry, RecordContent::Call { call, .. } if *call.method() == Method::Multicall)
    {
        return;
    }
    let fresh =
        format::encode_checkpoint(&Checkpoint::default(), 1).expect("cannot encode an empty state");
    let line = format::encode_record(record, fresh.stamp).expect("cannot encode what was read");
    let again = format::decode(&[fresh.bytes, line].concat()).expect("cannot read our own file");
    assert_eq!(again.records.as_slice(), std::slice::from_ref(record));
}

type File = Arc<Mutex<Vec<u8>>>;

fn id(file: &File) -> FileId {
    let (device, inode) = (0, Arc::as_ptr(file) as usize as u64);
    FileId { device, inode }
}

/// A disk that never fails and loses nothing.
#[derive(Clone, Default)]
struct Memory(Arc<Mutex<BTreeMap<PathBuf, File>>>);

impl Memory {
    fn put(&self, path: &Path, bytes: &[u8]) {
        let file = Arc::new(Mutex::new(bytes.to_vec()));
        self.0.lock().unwrap().insert(path.to_owned(), file);
    }

    fn file(&self, path: &Path) -> io::Result<File> {
        let files = self.0.lock().unwrap();
        let file = files.get(path).cloned();
        file.ok_or_else(|| io::ErrorKind::NotFound.into())
    }
}

impl Storage for Memory {
    type File = File;
    type Lock = ();

    fn locate(&self, path: &Path) -> io::Result<PathBuf> {
        Ok(path.to_owned())
    }

    fn lock(&self, _: &Path, _: &Path) -> io::Result<Result<(), Option<u32>>> {
        Ok(Ok(()))
    }

    fn renew_lock(&self, (): &mut (), _: &Path) -> io::Result<Result<(), Option<u32>>> {
        Ok(Ok(()))
    }

    fn lock_id(&self, (): &()) -> io::Result<FileId> {
        Ok(id(&File::default()))
    }

    fn read(&self, path: &Path, _: u64) -> io::Result<Vec<u8>> {
        Ok(self.file(path)?.lock().unwrap().clone())
    }

    fn create(&self, path: &Path) -> io::Result<File> {
        self.put(path, b"");
        self.file(path)
    }

    fn append(&self, file: &File, bytes: &[u8]) -> io::Result<usize> {
        file.lock().unwrap().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn sync(&self, _: &File) -> io::Result<()> {
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let file = self.file(from)?;
        let mut files = self.0.lock().unwrap();
        files.remove(from);
        files.insert(to.to_owned(), file);
        Ok(())
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<bool> {
        let file = self.file(from)?;
        self.0.lock().unwrap().insert(to.to_owned(), file);
        Ok(true)
    }

    fn replace(&self, from: &Path, path: &Path, aside: &Path) -> io::Result<()> {
        self.rename(path, aside)?;
        self.rename(from, path)
    }

    fn status(&self, file: &File) -> io::Result<FileStatus> {
        let length = file.lock().unwrap().len();
        Ok(FileStatus {
            id: id(file),
            length: length as u64,
            modified: 0,
        })
    }

    fn length_at(&self, path: &Path) -> io::Result<u64> {
        Ok(self.file(path)?.lock().unwrap().len() as u64)
    }

    fn id_at(&self, path: &Path) -> io::Result<Option<FileId>> {
        Ok(self.file(path).ok().as_ref().map(id))
    }

    fn checksum(&self, path: &Path, length: u64) -> io::Result<u32> {
        let file = self.file(path)?;
        let bytes = file.lock().unwrap();
        Ok(crc32c::crc32c(&bytes[..bytes.len().min(length as usize)]))
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let removed = self.0.lock().unwrap().remove(path);
        removed
            .map(drop)
            .ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    fn sync_dir(&self, _: &Path) -> io::Result<()> {
        Ok(())
    }

    fn list(&self, folder: &Path) -> io::Result<Vec<String>> {
        let files = self.0.lock().unwrap();
        let within = files.keys().filter(|path| path.starts_with(folder));
        Ok(within
            .filter_map(|path| Some(path.file_name()?.to_str()?.to_owned()))
            .collect())
    }
}
