//! Items of a table: every number of an item names the item, the field and the place.

use std::sync::{Arc, LazyLock};

use comic_proto::{Field, UnrollLayout, UnrollShape};
use comic_replay::{Sample, Table, TableConfig, Unrolls};
use rand::SeedableRng as _;
use rand_pcg::Pcg64;

/// A small layout in which no field is empty.
pub(crate) fn whole_layout() -> Arc<UnrollLayout> {
    static LAYOUT: LazyLock<Arc<UnrollLayout>> = LazyLock::new(|| {
        let shape = UnrollShape {
            length: 2,
            proprioception: 3,
            task: 4,
            action: 2,
            latent: 1,
            reward_terms: 2,
            image: 4,
            components: 2,
            state: 2,
            action_gradient: 2,
        };
        Arc::new(UnrollLayout::new(shape))
    });
    Arc::clone(&LAYOUT)
}

/// The task of item `number`.
pub(crate) fn task_of_item(number: u64) -> usize {
    number as usize % 3
}

/// Items with these numbers, which are below 2¹⁶, and their tasks.
pub(crate) fn items(numbers: impl IntoIterator<Item = u64>) -> (Unrolls, Vec<usize>) {
    let numbers: Vec<u64> = numbers.into_iter().collect();
    let mut unrolls = Unrolls::new(whole_layout(), numbers.len());
    for (slot, number) in numbers.iter().enumerate() {
        for field in Field::ALL {
            let bytes = content(field, *number);
            unrolls.bytes_mut(field, slot).copy_from_slice(&bytes);
        }
    }
    (unrolls, numbers.into_iter().map(task_of_item).collect())
}

/// The bytes of a field of an item.
fn content(field: Field, number: u64) -> Vec<u8> {
    let elements = 0..whole_layout().elements(field);
    let mark = |element: usize| ((number as u32) << 8) + ((field as u32) << 4) + element as u32 % 16;
    match field {
        Field::Clip => elements.flat_map(|_| (number as u32).to_le_bytes()).collect(),
        Field::Image => elements.map(|element| mark(element) as u8 ^ number as u8).collect(),
        _ => elements.flat_map(|element| (mark(element) as f32).to_le_bytes()).collect(),
    }
}

/// An empty table of at most `max_size` items.
pub(crate) fn table(max_size: usize) -> Table {
    Table::new(whole_layout(), TableConfig { max_size, sample_size: 1, memory: u64::MAX }).unwrap()
}

/// Inserts items with these numbers.
pub(crate) fn insert(table: &mut Table, numbers: impl IntoIterator<Item = u64>) {
    let (unrolls, tasks) = items(numbers);
    table.insert(&unrolls, &tasks);
}

/// A sample of `n` items; `None` if the table holds fewer.
pub(crate) fn sample(table: &mut Table, n: usize, random: &mut Pcg64) -> Option<Sample> {
    let mut sample = Sample::new(whole_layout(), n);
    table.sample(&mut sample, random).then_some(sample)
}

/// The numbers of the items of a sample, each of which is whole and has its task.
pub(crate) fn numbers(sample: &Sample) -> Vec<u64> {
    let rows = whole_layout().elements(Field::Clip);
    let numbers: Vec<u64> = sample.unrolls.clip().chunks_exact(rows).map(|clips| u64::from(clips[0])).collect();
    for (place, number) in numbers.iter().enumerate() {
        for field in Field::ALL {
            assert_eq!(sample.unrolls.bytes(field, place), content(field, *number), "{field} of item {number}");
        }
        assert_eq!(sample.tasks[place], task_of_item(*number));
    }
    numbers
}

/// The numbers of all items, the oldest first.
pub(crate) fn held(table: &mut Table) -> Vec<u64> {
    let Some(all) = sample(table, table.len(), &mut Pcg64::seed_from_u64(0)) else { return Vec::new() };
    let mut held: Vec<_> = all.ages.iter().copied().zip(numbers(&all)).collect();
    held.sort_unstable_by(|one, other| other.cmp(one));
    held.into_iter().map(|(_, number)| number).collect()
}
