//! The simulated disk's operations.

use std::io;
use std::path::{Path, PathBuf};

use super::{Inode, NameOp, SimFile, SimFs, Step};
use crate::{FileId, FileStatus, Storage};

impl Storage for SimFs {
    type File = SimFile;
    type Lock = SimFile;

    fn locate(&self, path: &Path) -> io::Result<PathBuf> {
        Ok(path.to_owned())
    }

    fn lock(&self, _: &Path, path: &Path) -> io::Result<Result<SimFile, Option<u32>>> {
        let mut world = self.0.lock().unwrap();
        let inode = world.find(path).unwrap_or_else(|_| world.add(path));
        Ok(Ok(SimFile(inode)))
    }

    fn renew_lock(&self, lock: &mut SimFile, path: &Path) -> io::Result<Result<(), Option<u32>>> {
        let renewed = self.lock(path, path)?;
        Ok(renewed.map(|file| *lock = file))
    }

    fn lock_id(&self, lock: &SimFile) -> io::Result<FileId> {
        Ok(lock.id())
    }

    fn read(&self, path: &Path, _limit: u64) -> io::Result<Vec<u8>> {
        let world = self.0.lock().unwrap();
        if world.dead {
            return Err(io::Error::other("the process is dead"));
        }
        let inode = &world.inodes[world.find(path)?];
        match inode.unreadable {
            true => Err(io::Error::from_raw_os_error(5)),
            false => Ok(inode.content()),
        }
    }

    fn create(&self, path: &Path) -> io::Result<SimFile> {
        let mut world = self.0.lock().unwrap();
        world.whole_step()?;
        let inode = world.inodes.len();
        world.inodes.push(Inode::default());
        world.record(NameOp::Set(path.to_owned(), inode));
        Ok(SimFile(inode))
    }

    fn append(&self, file: &SimFile, bytes: &[u8]) -> io::Result<usize> {
        let mut world = self.0.lock().unwrap();
        let taken = match world.step() {
            Step::Go => bytes.len(),
            Step::Partly(eighths) => bytes.len() * eighths / 8,
            Step::Fail(error) => return Err(error),
        };
        let inode = &mut world.inodes[file.0];
        assert!(!inode.poisoned, "a file whose sync failed was written");
        inode.writes.push(bytes[..taken].to_vec());
        inode.modified += 1;
        Ok(taken)
    }

    fn sync(&self, file: &SimFile) -> io::Result<()> {
        let mut world = self.0.lock().unwrap();
        assert!(!world.inodes[file.0].poisoned, "a failed sync was repeated");
        if let Err(error) = world.whole_step() {
            world.inodes[file.0].poisoned = true;
            return Err(error);
        }
        let inode = &mut world.inodes[file.0];
        inode.durable = inode.content();
        inode.writes.clear();
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let mut world = self.0.lock().unwrap();
        let inode = world.find(from)?;
        world.whole_step()?;
        world.record(NameOp::Move(from.to_owned(), to.to_owned(), inode));
        Ok(())
    }

    fn link(&self, from: &Path, to: &Path) -> io::Result<bool> {
        let mut world = self.0.lock().unwrap();
        let inode = world.find(from)?;
        world.whole_step()?;
        world.record(NameOp::Set(to.to_owned(), inode));
        Ok(true)
    }

    fn replace(&self, from: &Path, path: &Path, aside: &Path) -> io::Result<()> {
        let mut world = self.0.lock().unwrap();
        let (ours, theirs) = (world.find(from)?, world.find(path)?);
        world.whole_step()?;
        world.record(NameOp::Move(from.to_owned(), aside.to_owned(), ours));
        world.whole_step()?;
        world.record(NameOp::Swap([
            (path.to_owned(), ours),
            (aside.to_owned(), theirs),
        ]));
        Ok(())
    }

    fn status(&self, file: &SimFile) -> io::Result<FileStatus> {
        let world = self.0.lock().unwrap();
        let inode = &world.inodes[file.0];
        Ok(FileStatus {
            id: file.id(),
            length: inode.content().len() as u64,
            modified: inode.modified,
        })
    }

    fn length_at(&self, path: &Path) -> io::Result<u64> {
        let world = self.0.lock().unwrap();
        Ok(world.inodes[world.find(path)?].content().len() as u64)
    }

    fn id_at(&self, path: &Path) -> io::Result<Option<FileId>> {
        let inode = self.0.lock().unwrap().find(path);
        Ok(inode.ok().map(|inode| SimFile(inode).id()))
    }

    fn checksum(&self, path: &Path, length: u64) -> io::Result<u32> {
        let content = self.read(path, length)?;
        Ok(crc32c::crc32c(
            &content[..content.len().min(length as usize)],
        ))
    }

    fn remove(&self, path: &Path) -> io::Result<()> {
        let mut world = self.0.lock().unwrap();
        world.find(path)?;
        world.whole_step()?;
        world.record(NameOp::Remove(path.to_owned()));
        Ok(())
    }

    fn sync_dir(&self, _folder: &Path) -> io::Result<()> {
        let mut world = self.0.lock().unwrap();
        world.whole_step()?;
        world.durable_names = world.names.clone();
        world.pending.clear();
        Ok(())
    }

    fn list(&self, _folder: &Path) -> io::Result<Vec<String>> {
        let world = self.0.lock().unwrap();
        let name = |path: &PathBuf| path.file_name()?.to_str().map(str::to_owned);
        Ok(world.names.keys().filter_map(name).collect())
    }
}
