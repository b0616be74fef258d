use std::fs::{self, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{self, Receiver, Sender};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use mcap::WriteOptions;
use mcap::write::NoSeek;
use rayon::prelude::*;

use super::McapError;
use super::encode::{Encoder, RecordedCamera, check_names};
use crate::live::{Event, Observation, Sink, Statistics};

/// Writes what it is given to an MCAP file, in a thread of its own: masks too, where estimates have them.
///
/// What the thread does not keep up with is not recorded, by whole observations, and counted: nobody waits for a disk.
/// A second of the file is complete when it is over, so that a program that is killed loses no more than that.
/// When the file cannot be written, that is logged, the rest is ignored, and [`Recorder::finish`] says why.
#[derive(Debug)]
pub struct Recorder {
    file: PathBuf,
    /// `None` once it is finished.
    queue: Option<Sender<Item>>,
    shared: Arc<Shared>,
    ended: Receiver<Result<(), McapError>>,
    /// How many unrecorded observations were told of.
    told: u64,
}

/// What both threads see.
#[derive(Debug, Default)]
struct Shared {
    /// Bytes that wait for the thread.
    waiting: AtomicUsize,
    /// Observations that are not in the file.
    unrecorded: AtomicU64,
    /// Until when observations that wait are still written, once nothing more comes.
    until: OnceLock<Instant>,
}

enum Item {
    Observation(Box<Observation>),
    Event(Event),
    Statistics(Statistics),
}

/// Bytes of images that may wait: a disk's hiccup of a second with four cameras of 1280 x 720 at 15 Hz.
const QUEUE: usize = 256 << 20;
/// Beyond those, bytes of events and statistics that may wait.
const RESERVE: usize = 1 << 20;
/// Bytes of a chunk, where a second has more.
const CHUNK: usize = 4 << 20;
/// How long observations that wait are still written in the end.
const DRAIN: Duration = Duration::from_millis(500);
/// How long the file has to be complete in the end.
const FINISH: Duration = Duration::from_millis(900);

impl Recorder {
    /// Records `cameras`, in the configuration's order, to a new file.
    ///
    /// # Errors
    /// A file that is there already or cannot be made, and what [`Recorder::new`] refuses.
    pub fn create(file: impl Into<PathBuf>, cameras: &[RecordedCamera]) -> Result<Self, McapError> {
        check_names(cameras)?;
        let file = file.into();
        match OpenOptions::new().write(true).create_new(true).open(&file) {
            Ok(writer) => Self::in_new_file(writer, file, cameras),
            Err(cause) if cause.kind() == ErrorKind::AlreadyExists => {
                Err(McapError::Taken { file })
            }
            Err(cause) => Err(McapError::Create { file, cause }),
        }
    }

    /// Takes `file`, which was not there before, away again where nothing can be recorded: the next try finds none.
    fn in_new_file(
        writer: impl Write + Send + 'static,
        file: PathBuf,
        cameras: &[RecordedCamera],
    ) -> Result<Self, McapError> {
        let recorder = Self::new(writer, &file, cameras);
        if recorder.is_err() {
            // Where it stays, that is told when it is in the way.
            let _ = fs::remove_file(&file);
        }
        recorder
    }

    /// Records `cameras` to whatever can be written; `file` is what messages call it.
    ///
    /// # Errors
    /// Two cameras of the same topics; a writer or a system that fails at once.
    pub fn new(
        writer: impl Write + Send + 'static,
        file: impl Into<PathBuf>,
        cameras: &[RecordedCamera],
    ) -> Result<Self, McapError> {
        check_names(cameras)?;
        let file = file.into();
        // Chunks are written whole, so that a file that ends early has no chunk that says that it is empty. Nothing is
        // compressed: nearly all is pictures, which are already.
        let writer = WriteOptions::new()
            .profile("ros2")
            .library(concat!("whereabot ", env!("CARGO_PKG_VERSION")))
            .compression(None)
            .chunk_size(None)
            .disable_seeking(true)
            .create(NoSeek::new(writer))
            .and_then(|mut writer| {
                let encoder = Encoder::new(&mut writer, cameras)?;
                Ok((writer, encoder))
            });
        let (writer, encoder) = writer.map_err(|cause| McapError::Write {
            file: file.clone(),
            cause,
        })?;

        let shared = Arc::new(Shared::default());
        let (queue, items) = mpsc::channel();
        let (end, ended) = mpsc::sync_channel(1);
        let mut thread = Thread {
            file: file.clone(),
            writer,
            encoder,
            shared: Arc::clone(&shared),
            pending: 0,
        };
        let started = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || {
                let result = thread.run(&items);
                if let Err(error) = &result {
                    log::error!("{error}");
                    thread.ignore(&items);
                }
                // Nobody listens any more where it took too long.
                let _ = end.send(result);
            });
        started.map_err(|cause| McapError::Create {
            file: file.clone(),
            cause,
        })?;
        Ok(Self {
            file,
            queue: Some(queue),
            shared,
            ended,
            told: 0,
        })
    }

    /// How many observations are not in the file, because it could not be written fast enough or not at all.
    pub fn unrecorded(&self) -> u64 {
        self.shared.unrecorded.load(Ordering::Relaxed)
    }

    /// Brings the file to its end, within a second: what waits is written, the oldest first, for half of that, and then the
    /// index. What is given later is ignored.
    ///
    /// # Errors
    /// Why the recording ended early.
    pub fn finish(&mut self) -> Result<(), McapError> {
        let Some(queue) = self.queue.take() else {
            return Ok(());
        };
        let _ = self.shared.until.set(Instant::now() + DRAIN);
        drop(queue);
        let result = self.ended.recv_timeout(FINISH).unwrap_or_else(|_| {
            Err(McapError::Unfinished {
                file: self.file.clone(),
                limit: FINISH,
            })
        });
        self.tell();
        result
    }

    fn push(&mut self, item: Item) {
        let bytes = item.bytes();
        let most = match item {
            Item::Observation(_) => QUEUE,
            Item::Event(_) | Item::Statistics(_) => QUEUE + RESERVE,
        };
        let waiting = self.shared.waiting.load(Ordering::Relaxed);
        match &self.queue {
            Some(queue) if waiting == 0 || waiting + bytes <= most => {
                self.shared.waiting.fetch_add(bytes, Ordering::Relaxed);
                // The thread listens for as long as this sender is there.
                let _ = queue.send(item);
            }
            _ => self.shared.miss(&item),
        }
    }

    /// Says how many observations are missing, where there are more than it said last.
    fn tell(&mut self) {
        let unrecorded = self.unrecorded();
        if unrecorded > self.told {
            let file = self.file.display();
            log::warn!("{file}: {unrecorded} observations so far are not recorded");
            self.told = unrecorded;
        }
    }
}

impl Sink for Recorder {
    fn observation(&mut self, observation: &Observation) {
        self.push(Item::Observation(Box::new(observation.clone())));
    }

    fn event(&mut self, event: &Event) {
        self.push(Item::Event(event.clone()));
    }

    fn statistics(&mut self, statistics: &Statistics) {
        self.tell();
        self.push(Item::Statistics(statistics.clone()));
    }

    fn finish(&mut self) -> Result<(), Box<dyn std::error::Error + Send + Sync>> {
        Ok(Recorder::finish(self)?)
    }
}

impl Drop for Recorder {
    fn drop(&mut self) {
        // The thread has logged why it gave up.
        if let Err(error @ McapError::Unfinished { .. }) = Recorder::finish(self) {
            log::error!("{error}");
        }
    }
}

impl Item {
    /// About as many as it has in memory.
    fn bytes(&self) -> usize {
        const LITTLE: usize = 1 << 10;
        match self {
            Self::Observation(observation) => {
                let mask = &observation.estimate.mask;
                let mask = mask.as_ref().map_or(0, |mask| 4 * mask.probability.len());
                LITTLE + observation.image.len() + mask
            }
            Self::Event(_) | Self::Statistics(_) => LITTLE,
        }
    }
}

impl Shared {
    /// Counts what is not recorded.
    fn miss(&self, item: &Item) {
        if matches!(item, Item::Observation(_)) {
            self.unrecorded.fetch_add(1, Ordering::Relaxed);
        }
    }
}

/// The thread that encodes and writes.
struct Thread<W: Write> {
    file: PathBuf,
    writer: mcap::Writer<NoSeek<W>>,
    encoder: Encoder,
    shared: Arc<Shared>,
    /// Observations in the chunk that is not written yet.
    pending: u64,
}

impl<W: Write> Thread<W> {
    fn run(&mut self, items: &Receiver<Item>) -> Result<(), McapError> {
        // Threads of its own: those of the program are for what results wait for.
        let threads = std::thread::available_parallelism().map_or(1, |n| n.get().div_ceil(2));
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|index| format!("recorder-{index}"))
            .build()
            .map_err(|cause| self.failed(cause.to_string()))?;
        let mut chunk = 0;
        while let Ok(first) = items.recv() {
            let some = std::iter::once(first).chain(items.try_iter());
            let mut some: Vec<Item> = some.take(threads).collect();
            let bytes: usize = some.iter().map(Item::bytes).sum();
            if self
                .shared
                .until
                .get()
                .is_some_and(|at| at.elapsed() > Duration::ZERO)
            {
                some.iter().for_each(|item| self.shared.miss(item));
                some.retain(|item| !matches!(item, Item::Observation(_)));
            }
            self.pending += some
                .iter()
                .filter(|item| matches!(item, Item::Observation(_)))
                .count() as u64;

            let (encoder, shared) = (&self.encoder, &self.shared);
            let encoded: Result<Vec<_>, _> = pool.install(|| {
                some.par_iter()
                    .map(|item| match item {
                        Item::Observation(observation) => encoder.observation(observation),
                        Item::Event(event) => encoder.event(event),
                        Item::Statistics(statistics) => {
                            let unrecorded = shared.unrecorded.load(Ordering::Relaxed);
                            encoder.statistics(statistics, unrecorded)
                        }
                    })
                    .collect()
            });
            let encoded = encoded.map_err(|message| self.failed(message))?;
            for message in encoded.iter().flatten() {
                let written = message.write(&mut self.writer);
                chunk += written.map_err(|cause| self.unwritten(cause))?;
            }
            let second = some.iter().any(|item| matches!(item, Item::Statistics(_)));
            if second || chunk > CHUNK {
                let flushed = self.writer.flush();
                flushed.map_err(|cause| self.unwritten(cause))?;
                chunk = 0;
                self.pending = 0;
            }
            self.shared.waiting.fetch_sub(bytes, Ordering::Relaxed);
        }
        let finished = self.writer.finish();
        finished.map_err(|cause| self.unwritten(cause))?;
        Ok(())
    }

    /// Lets nothing wait any more, until nothing more comes.
    fn ignore(&mut self, items: &Receiver<Item>) {
        self.shared
            .unrecorded
            .fetch_add(self.pending, Ordering::Relaxed);
        for item in items {
            self.shared.miss(&item);
            self.shared
                .waiting
                .fetch_sub(item.bytes(), Ordering::Relaxed);
        }
    }

    fn failed(&self, message: String) -> McapError {
        let file = self.file.clone();
        McapError::Message { file, message }
    }

    fn unwritten(&self, cause: mcap::McapError) -> McapError {
        let file = self.file.clone();
        McapError::Write { file, cause }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::io;

    use super::*;

    /// A disk that is full from the beginning, or is not.
    struct Disk {
        full: bool,
    }

    impl Write for Disk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.full {
                return Err(ErrorKind::StorageFull.into());
            }
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_recording_that_cannot_begin_leaves_no_file() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("out.mcap");
        for full in [true, false] {
            fs::write(&file, b"").unwrap();
            let recorder = Recorder::in_new_file(Disk { full }, file.clone(), &[]);
            assert_eq!((recorder.is_err(), file.exists()), (full, !full));
        }
    }
}
