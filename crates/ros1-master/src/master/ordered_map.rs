//! A map that keeps the order of its keys, like a Python dict, and whose copies share memory.

use std::{
    fmt,
    hash::{BuildHasher, RandomState},
    slice,
    sync::{Arc, LazyLock},
    vec,
};

use hashbrown::HashTable;

/// Number of slots in a chunk.
const CHUNK: usize = 128;
/// Number of keys per shard from which the index gets more shards.
const SHARD_MAX: usize = 256;

static HASHER: LazyLock<RandomState> = LazyLock::new(RandomState::new);

/// A map that keeps the order in which its keys were added, like a Python dict.
///
/// A clone shares all memory with its original until one of the two is changed. That change copies one chunk of 128
/// pointers, one shard of the index and the entry itself, and counts the other chunks and shards: some microseconds in a
/// map of 50,000 entries. Maps that share memory are compared quickly.
pub struct OrderedMap<V>(Arc<Inner<V>>);

struct Inner<V> {
    /// The entries in their order. All chunks but the last one have [`CHUNK`] slots.
    chunks: Vec<Arc<Chunk<V>>>,
    /// Where each key is, in shards by the key's hash. The number of shards is a power of four.
    shards: Vec<Arc<HashTable<Slot>>>,
    len: usize,
}

/// Slots for entries. A removed entry leaves its slot empty.
type Chunk<V> = Vec<Option<Arc<Entry<V>>>>;

#[derive(Clone, PartialEq, Eq)]
struct Entry<V> {
    key: String,
    value: V,
}

#[derive(Clone, Copy)]
struct Slot {
    hash: u64,
    /// The slot's number, counted through all chunks.
    number: u32,
}

impl<V> OrderedMap<V> {
    pub fn len(&self) -> usize {
        self.0.len
    }

    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    pub fn get(&self, key: &str) -> Option<&V> {
        let entry = self.0.entry(self.0.slot(key)?.number)?;
        Some(&entry.value)
    }

    pub fn contains_key(&self, key: &str) -> bool {
        self.0.slot(key).is_some()
    }

    /// The key as the map holds it, with its value.
    pub fn get_key_value(&self, key: &str) -> Option<(&String, &V)> {
        let entry = self.0.entry(self.0.slot(key)?.number)?;
        Some((&entry.key, &entry.value))
    }

    /// The keys and values in order.
    pub fn iter(&self) -> Iter<'_, V> {
        Iter {
            chunks: self.0.chunks.iter(),
            chunk: [].iter(),
            left: self.0.len,
        }
    }

    /// The keys in order.
    pub fn keys(&self) -> impl ExactSizeIterator<Item = &String> + Clone {
        self.iter().map(|(key, _)| key)
    }

    /// The values in the order of their keys.
    pub fn values(&self) -> impl ExactSizeIterator<Item = &V> + Clone {
        self.iter().map(|(_, value)| value)
    }
}

impl<V: Clone> OrderedMap<V> {
    /// The value of `key`, to be changed.
    pub fn get_mut(&mut self, key: &str) -> Option<&mut V> {
        let number = self.0.slot(key)?.number;
        Arc::make_mut(&mut self.0).value_mut(number)
    }

    /// Sets the value of `key`. A new key comes last.
    pub fn insert(&mut self, key: String, value: V) {
        match self.get_mut(&key) {
            Some(present) => *present = value,
            None => {
                Arc::make_mut(&mut self.0).push(Arc::new(Entry { key, value }));
            }
        }
    }

    /// Keeps only the entries for which `keep` returns true.
    pub fn retain(&mut self, mut keep: impl FnMut(&str, &mut V) -> bool) {
        let entries = std::mem::take(self).into_iter();
        let kept = entries.filter_map(|(key, mut value)| {
            let stays = keep(&key, &mut value);
            stays.then_some((key, value))
        });
        *self = kept.collect();
    }

    /// Removes `key`. The others keep their order.
    pub fn remove(&mut self, key: &str) {
        if let Some(slot) = self.0.slot(key) {
            Arc::make_mut(&mut self.0).remove(slot);
        }
    }
}

impl<V> Inner<V> {
    fn slot(&self, key: &str) -> Option<Slot> {
        let hash = HASHER.hash_one(key);
        let shard = self.shards.get(shard_of(hash, self.shards.len()))?;
        let is_it = |slot: &Slot| {
            slot.hash == hash && self.entry(slot.number).is_some_and(|it| it.key == key)
        };
        shard.find(hash, is_it).copied()
    }

    fn entry(&self, number: u32) -> Option<&Arc<Entry<V>>> {
        let number = number as usize;
        self.chunks
            .get(number / CHUNK)?
            .get(number % CHUNK)?
            .as_ref()
    }

    /// The entries of all chunks but the first `skip` ones.
    fn entries(&self, skip: usize) -> impl Iterator<Item = &Arc<Entry<V>>> {
        let chunks = self.chunks.iter().skip(skip);
        chunks.flat_map(|chunk| chunk.iter().flatten())
    }

    /// Number of slots, empty ones included.
    fn slots(&self) -> usize {
        let full = self.chunks.len().saturating_sub(1) * CHUNK;
        full + self.chunks.last().map_or(0, |last| last.len())
    }
}

impl<V: Clone> Inner<V> {
    fn value_mut(&mut self, number: u32) -> Option<&mut V> {
        let number = number as usize;
        let chunk = Arc::make_mut(self.chunks.get_mut(number / CHUNK)?);
        let entry = chunk.get_mut(number % CHUNK)?.as_mut()?;
        Some(&mut Arc::make_mut(entry).value)
    }

    /// Adds an entry whose key the map does not have.
    fn push(&mut self, entry: Arc<Entry<V>>) {
        let hash = HASHER.hash_one(&entry.key);
        // An entry needs more than a byte of memory, so there are never that many.
        let number = u32::try_from(self.slots()).unwrap_or(u32::MAX);
        match self.chunks.last_mut().filter(|last| last.len() < CHUNK) {
            Some(last) => Arc::make_mut(last).push(Some(entry)),
            None => self.chunks.push(Arc::new(vec![Some(entry)])),
        }
        self.len += 1;
        if self.len > self.shards.len() * SHARD_MAX {
            self.add_shards();
        }
        self.index(Slot { hash, number });
    }

    fn index(&mut self, slot: Slot) {
        let count = self.shards.len();
        if let Some(shard) = self.shards.get_mut(shard_of(slot.hash, count)) {
            Arc::make_mut(shard).insert_unique(slot.hash, slot, |slot| slot.hash);
        }
    }

    fn add_shards(&mut self) {
        let count = (self.shards.len() * 4).max(1);
        let shards = vec![Arc::default(); count];
        for shard in std::mem::replace(&mut self.shards, shards) {
            shard.iter().for_each(|slot| self.index(*slot));
        }
    }

    fn remove(&mut self, slot: Slot) {
        let count = self.shards.len();
        if let Some(shard) = self.shards.get_mut(shard_of(slot.hash, count)) {
            let is_it = |of: &Slot| of.number == slot.number;
            if let Ok(found) = Arc::make_mut(shard).find_entry(slot.hash, is_it) {
                found.remove();
            }
        }
        let number = slot.number as usize;
        let chunk = self.chunks.get_mut(number / CHUNK);
        if let Some(slot) = chunk.and_then(|chunk| Arc::make_mut(chunk).get_mut(number % CHUNK)) {
            *slot = None;
        }
        self.len -= 1;
        // Each removal has made one empty slot, so this costs little on average.
        if self.slots() > 2 * self.len + CHUNK {
            let entries: Vec<_> = self.entries(0).cloned().collect();
            *self = Self::default();
            entries.into_iter().for_each(|entry| self.push(entry));
        }
    }
}

/// The keys and values of an [`OrderedMap`] in order.
pub struct Iter<'a, V> {
    chunks: slice::Iter<'a, Arc<Chunk<V>>>,
    chunk: slice::Iter<'a, Option<Arc<Entry<V>>>>,
    left: usize,
}

impl<'a, V> Iterator for Iter<'a, V> {
    type Item = (&'a String, &'a V);

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(entry) = self.chunk.by_ref().flatten().next() {
                self.left -= 1;
                return Some((&entry.key, &entry.value));
            }
            self.chunk = self.chunks.next()?.iter();
        }
    }

    fn size_hint(&self) -> (usize, Option<usize>) {
        (self.left, Some(self.left))
    }
}

impl<V> ExactSizeIterator for Iter<'_, V> {}

impl<V> Clone for Iter<'_, V> {
    fn clone(&self) -> Self {
        Self {
            chunks: self.chunks.clone(),
            chunk: self.chunk.clone(),
            left: self.left,
        }
    }
}

impl<'a, V> IntoIterator for &'a OrderedMap<V> {
    type Item = (&'a String, &'a V);
    type IntoIter = Iter<'a, V>;

    fn into_iter(self) -> Iter<'a, V> {
        self.iter()
    }
}

impl<V: Clone> IntoIterator for OrderedMap<V> {
    type Item = (String, V);
    type IntoIter = vec::IntoIter<(String, V)>;

    fn into_iter(self) -> Self::IntoIter {
        let chunks = Arc::unwrap_or_clone(self.0).chunks.into_iter();
        let entries = chunks.flat_map(Arc::unwrap_or_clone).flatten();
        let entries = entries.map(Arc::unwrap_or_clone);
        let entries: Vec<_> = entries.map(|entry| (entry.key, entry.value)).collect();
        entries.into_iter()
    }
}

/// The shard for `hash`. Takes other bits than the shards themselves use.
fn shard_of(hash: u64, count: usize) -> usize {
    (hash >> 32) as usize & count.wrapping_sub(1)
}

impl<V> Default for Inner<V> {
    fn default() -> Self {
        Self {
            chunks: Vec::new(),
            shards: Vec::new(),
            len: 0,
        }
    }
}

impl<V> Clone for Inner<V> {
    fn clone(&self) -> Self {
        Self {
            chunks: self.chunks.clone(),
            shards: self.shards.clone(),
            len: self.len,
        }
    }
}

impl<V> Default for OrderedMap<V> {
    fn default() -> Self {
        Self(Arc::default())
    }
}

impl<V> Clone for OrderedMap<V> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

/// Compares keys, values and their order.
impl<V: Eq> PartialEq for OrderedMap<V> {
    fn eq(&self, other: &Self) -> bool {
        let (a, b) = (&self.0.chunks, &other.0.chunks);
        // Chunks or entries with equal pointers are equal. Chunks with other empty slots may still hold the same.
        let is_same = |(a, b): &(&Arc<Chunk<V>>, &Arc<Chunk<V>>)| {
            Arc::ptr_eq(a, b) || a.iter().flatten().eq(b.iter().flatten())
        };
        let same = a.iter().zip(b).take_while(is_same).count();
        self.len() == other.len() && self.0.entries(same).eq(other.0.entries(same))
    }
}

impl<V: Eq> OrderedMap<V> {
    /// Whether both maps have the same keys with the same values, in any order.
    pub fn has_same(&self, other: &Self) -> bool {
        let is_in_other = |(key, value): (&String, &V)| other.get(key) == Some(value);
        self == other || (self.len() == other.len() && self.iter().all(is_in_other))
    }
}

impl<V: Clone> FromIterator<(String, V)> for OrderedMap<V> {
    fn from_iter<I: IntoIterator<Item = (String, V)>>(entries: I) -> Self {
        let mut map = Self::default();
        for (key, value) in entries {
            map.insert(key, value);
        }
        map
    }
}

impl<V: Clone, const N: usize> From<[(String, V); N]> for OrderedMap<V> {
    fn from(entries: [(String, V); N]) -> Self {
        entries.into_iter().collect()
    }
}

impl<V: fmt::Debug> fmt::Debug for OrderedMap<V> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_map().entries(self).finish()
    }
}

#[cfg(test)]
mod tests {
    use indexmap::IndexMap;

    use super::*;

    /// Random numbers: a linear congruential generator.
    struct Dice(u64);

    impl Dice {
        fn below(&mut self, most: u64) -> u64 {
            let Self(seed) = self;
            *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (*seed >> 33) % most
        }
    }

    fn same(map: &OrderedMap<u64>, model: &IndexMap<String, u64>) {
        assert_eq!(map.len(), model.len());
        assert!(map.iter().eq(model.iter()));
    }

    #[test]
    fn it_keeps_order_and_no_change_shows_in_a_copy() {
        let mut dice = Dice(1);
        let (mut map, mut model) = (OrderedMap::default(), IndexMap::new());
        let mut copies = Vec::new();
        for round in 0..40_000 {
            // Grows at first, then shrinks.
            let removes = if round < 20_000 { 2 } else { 7 };
            let key = format!("/key_{}", dice.below(3_000));
            if dice.below(10) < removes {
                map.remove(&key);
                model.shift_remove(&key);
            } else {
                map.insert(key.clone(), round);
                model.insert(key.clone(), round);
            }
            assert_eq!(map.get(&key), model.get(&key));
            if dice.below(4_000) == 0 {
                copies.push((map.clone(), model.clone()));
            }
        }
        same(&map, &model);
        assert!(!copies.is_empty());
        for (map, model) in &copies {
            same(map, model);
        }
        for key in model.keys().cloned().collect::<Vec<_>>() {
            map.remove(&key);
        }
        assert!(map.is_empty() && map.iter().next().is_none());
    }

    #[test]
    fn a_change_after_a_copy_copies_one_entry_one_chunk_and_one_shard() {
        let keys = (0..50_000).map(|key| (format!("/key_{key}"), vec![key]));
        let mut map: OrderedMap<Vec<u64>> = keys.collect();
        let copied = |changed: &OrderedMap<Vec<u64>>, from: &OrderedMap<Vec<u64>>| {
            let (a, b) = (&changed.0, &from.0);
            let chunks = a.chunks.iter().zip(&b.chunks);
            let shards = a.shards.iter().zip(&b.shards);
            let entries = a.entries(0).zip(b.entries(0));
            (
                entries.filter(|(a, b)| !Arc::ptr_eq(a, b)).count(),
                chunks.filter(|(a, b)| !Arc::ptr_eq(a, b)).count(),
                shards.filter(|(a, b)| !Arc::ptr_eq(a, b)).count(),
            )
        };
        let copy = map.clone();
        map.get_mut("/key_777").unwrap().push(1);
        assert_eq!(copied(&map, &copy), (1, 1, 0));
        assert_eq!(copy.get("/key_777"), Some(&vec![777]));
        let copy = map.clone();
        map.insert("/new".to_owned(), vec![2]);
        assert_eq!(copied(&map, &copy), (0, 1, 1));
        let copy = map.clone();
        map.remove("/new");
        assert_eq!(copied(&map, &copy), (0, 1, 1));
    }

    #[test]
    fn equal_maps_have_the_same_order_whatever_their_history() {
        let of = |keys: &[u64]| -> OrderedMap<u64> {
            keys.iter().map(|key| (key.to_string(), *key)).collect()
        };
        let mut gap = of(&[1, 2, 3]);
        gap.remove("2");
        assert!(gap == of(&[1, 3]));
        assert!(gap != of(&[3, 1]));
        assert!(gap.has_same(&of(&[3, 1])));
        assert!(!gap.has_same(&of(&[1, 2])));
        // A key that is removed and added again comes last.
        gap.insert("1".to_owned(), 1);
        assert!(gap == of(&[1, 3]));
        gap.remove("1");
        gap.insert("1".to_owned(), 1);
        assert!(gap == of(&[3, 1]));
    }
}
