//! Simulates a disk that can stop, lose everything that was not synced, and fail.

mod storage;

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use super::FileId;

/// How an operation fails.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fault {
    /// The process is killed before this operation. A write still writes this many eighths of its bytes.
    Kill(usize),
    /// This operation and all later ones fail with this error number. A write first writes half of its bytes
    /// and reports that.
    Short(i32),
    /// This operation and all later ones fail with this error number.
    Errno(i32),
    /// Only this operation fails with this error number.
    Once(i32),
}

/// A file with its durable content, and the writes since the last sync.
#[derive(Clone, Default)]
struct Inode {
    durable: Vec<u8>,
    writes: Vec<Vec<u8>>,
    /// Stands for the modification time: the number of writes so far.
    modified: i128,
    /// Whether the disk fails to read this file.
    unreadable: bool,
    /// Whether a sync of this file failed. Using the file again is an error, because its unwritten pages may be lost.
    poisoned: bool,
}

impl Inode {
    fn content(&self) -> Vec<u8> {
        [self.durable.clone(), self.writes.concat()].concat()
    }
}

/// A change of names since the folder was last synced.
#[derive(Clone)]
enum NameOp {
    Set(PathBuf, usize),
    Move(PathBuf, PathBuf, usize),
    Remove(PathBuf),
    Swap([(PathBuf, usize); 2]),
}

impl NameOp {
    fn apply(&self, names: &mut BTreeMap<PathBuf, usize>) {
        match self {
            Self::Set(path, inode) => {
                names.insert(path.clone(), *inode);
            }
            Self::Move(from, to, inode) => {
                if names.get(from) == Some(inode) {
                    names.remove(from);
                }
                names.insert(to.clone(), *inode);
            }
            Self::Remove(path) => {
                names.remove(path);
            }
            Self::Swap(pairs) => names.extend(pairs.clone()),
        }
    }
}

#[derive(Clone, Default)]
struct World {
    inodes: Vec<Inode>,
    names: BTreeMap<PathBuf, usize>,
    durable_names: BTreeMap<PathBuf, usize>,
    pending: Vec<NameOp>,
    /// Number of modifying operations so far.
    ops: usize,
    fault: Option<(usize, Fault)>,
    hit: bool,
    dead: bool,
}

/// The simulated disk. Clones share it.
#[derive(Clone, Default)]
pub(super) struct SimFs(Arc<Mutex<World>>);

pub(super) struct SimFile(usize);

impl SimFile {
    fn id(&self) -> FileId {
        let (device, inode) = (0, self.0 as u64);
        FileId { device, inode }
    }
}

/// Whether an operation may proceed.
enum Step {
    Go,
    Partly(usize),
    Fail(io::Error),
}

impl World {
    /// Counts an operation and returns whether it may proceed.
    fn step(&mut self) -> Step {
        let op = self.ops;
        self.ops += 1;
        let gone = || Step::Fail(io::Error::other("the process is dead"));
        if self.dead {
            return gone();
        }
        match self.fault {
            Some((at, Fault::Kill(eighths))) if op == at => {
                (self.dead, self.hit) = (true, true);
                Step::Partly(eighths)
            }
            Some((at, Fault::Errno(errno))) if op >= at => {
                self.hit = true;
                Step::Fail(io::Error::from_raw_os_error(errno))
            }
            Some((at, Fault::Once(errno))) if op == at => {
                self.hit = true;
                Step::Fail(io::Error::from_raw_os_error(errno))
            }
            Some((at, Fault::Short(errno))) if op >= at => {
                self.hit = true;
                if op == at {
                    Step::Partly(4)
                } else {
                    Step::Fail(io::Error::from_raw_os_error(errno))
                }
            }
            _ => Step::Go,
        }
    }

    /// Counts an operation that happens as a whole or not at all, and fails if it may not proceed.
    fn whole_step(&mut self) -> io::Result<()> {
        match self.step() {
            Step::Go => Ok(()),
            Step::Partly(_) => Err(io::Error::from_raw_os_error(5)),
            Step::Fail(error) => Err(error),
        }
    }

    fn find(&self, path: &Path) -> io::Result<usize> {
        self.names
            .get(path)
            .copied()
            .ok_or_else(|| io::ErrorKind::NotFound.into())
    }

    /// Adds a new file with a durable name.
    fn add(&mut self, path: &Path) -> usize {
        let inode = self.inodes.len();
        self.inodes.push(Inode::default());
        self.names.insert(path.to_owned(), inode);
        self.durable_names.insert(path.to_owned(), inode);
        inode
    }

    fn record(&mut self, op: NameOp) {
        op.apply(&mut self.names);
        self.pending.push(op);
    }
}

impl SimFs {
    /// Makes operation number `at`, counted from now, fail.
    pub(super) fn arm(&self, at: usize, fault: Fault) {
        let mut world = self.0.lock().unwrap();
        world.fault = Some((world.ops + at, fault));
        world.hit = false;
    }

    /// Ends all faults. Returns whether one has occurred.
    pub(super) fn disarm(&self) -> bool {
        let mut world = self.0.lock().unwrap();
        world.fault = None;
        world.hit
    }

    /// Acts as another process that writes `bytes` to `path`, as a new file or in place.
    pub(super) fn overwrite(&self, path: &Path, bytes: &[u8], in_place: bool) {
        let mut world = self.0.lock().unwrap();
        let inode = match world.find(path) {
            Ok(inode) if in_place => inode,
            _ => world.add(path),
        };
        let modified = world.inodes[inode].modified + (1 << 60);
        world.inodes[inode] = Inode {
            durable: bytes.to_vec(),
            modified,
            ..Inode::default()
        };
    }

    /// Makes the file at `path` unreadable.
    pub(super) fn make_unreadable(&self, path: &Path) {
        let mut world = self.0.lock().unwrap();
        let inode = world.find(path).unwrap();
        world.inodes[inode].unreadable = true;
    }

    /// Acts as another process that removes the file at `path`.
    pub(super) fn take_away(&self, path: &Path) {
        let mut world = self.0.lock().unwrap();
        world.names.remove(path);
        world.durable_names.remove(path);
    }

    /// Whether any file on the disk has this content.
    pub(super) fn has(&self, bytes: &[u8]) -> bool {
        let world = self.0.lock().unwrap();
        let mut inodes = world.names.values();
        inodes.any(|inode| world.inodes[*inode].content() == bytes)
    }

    /// Number of operations so far.
    pub(super) fn ops(&self) -> usize {
        self.0.lock().unwrap().ops
    }

    fn booted(mut world: World) -> Self {
        world.pending.clear();
        world.durable_names = world.names.clone();
        for inode in &mut world.inodes {
            *inode = Inode {
                durable: inode.content(),
                unreadable: inode.unreadable,
                ..Inode::default()
            };
        }
        (world.fault, world.dead, world.ops) = (None, false, 0);
        Self(Arc::new(Mutex::new(world)))
    }

    /// The disk that the next process finds after a kill: all writes are there, and the kill has made none of them
    /// durable.
    pub(super) fn after_kill(&self) -> Self {
        let mut world = self.0.lock().unwrap().clone();
        (world.fault, world.dead, world.ops) = (None, false, 0);
        world
            .inodes
            .iter_mut()
            .for_each(|inode| inode.poisoned = false);
        Self(Arc::new(Mutex::new(world)))
    }

    /// The disks that a loss of power may leave. Any subset of the renames may have happened. Each file has its synced
    /// content, followed by nothing or by each later write, unchanged or as zeros; the last write may be cut at any
    /// eighth. Returns all combinations, or about `limit` of them if there are more.
    pub(super) fn after_power_loss(&self, limit: usize) -> Vec<Self> {
        let world = self.0.lock().unwrap().clone();
        let unsynced: Vec<usize> = (0..world.inodes.len())
            .filter(|nth| !world.inodes[*nth].writes.is_empty())
            .collect();
        let ways = |nth: &usize| (8_usize << world.inodes[*nth].writes.len()) + 1;
        let combinations = unsynced.iter().map(ways).product::<usize>() << world.pending.len();
        // An odd stride combines every choice of names with every other choice.
        let stride = (combinations / limit) | 1;
        let mut seen = BTreeSet::new();
        let mut images = Vec::new();
        for choice in (0..combinations).step_by(stride) {
            let mut image = world.clone();
            image.names = world.durable_names.clone();
            let mut rest = choice;
            for op in &world.pending {
                if rest & 1 == 1 {
                    op.apply(&mut image.names);
                }
                rest >>= 1;
            }
            for nth in &unsynced {
                let way = rest % ways(nth);
                rest /= ways(nth);
                let writes = &mut image.inodes[*nth].writes;
                if way == 0 {
                    writes.clear();
                    continue;
                }
                for (bit, write) in writes.iter_mut().enumerate() {
                    if (way - 1) >> bit & 1 == 1 {
                        write.fill(0);
                    }
                }
                let eighths = 8 - ((way - 1) >> writes.len());
                let last = writes.last_mut().unwrap();
                last.truncate(last.len() * eighths / 8);
            }
            let files: Vec<_> = image
                .names
                .iter()
                .map(|(path, inode)| (path.clone(), image.inodes[*inode].content()))
                .collect();
            if seen.insert(files) {
                images.push(Self::booted(image));
            }
        }
        images
    }
}
