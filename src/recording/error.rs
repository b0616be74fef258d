use std::path::PathBuf;

/// Why a recording could not be read or continued.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// A file or folder could not be read or written.
    #[error("{}: {cause}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        cause: std::io::Error,
    },
    /// A recording's header is not what the format asks for.
    #[error("{}: {message}", path.display())]
    Header {
        /// The recording's `recording.json`.
        path: PathBuf,
        /// What was expected and what was found.
        message: String,
    },
    /// A sample, or one of its pictures, is not what the format asks for.
    #[error("{}:{line}: {message}", path.display())]
    Line {
        /// The recording's `samples.jsonl`.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What was expected and what was found.
        message: String,
    },
    /// A recording without samples.
    #[error("{}: expected at least one sample, found none", path.display())]
    NoSamples {
        /// The recording's `samples.jsonl`.
        path: PathBuf,
    },
    /// The output folder already holds something that this request does not continue.
    #[error("{}: {message}", path.display())]
    OutputTaken {
        /// The file or folder in the way.
        path: PathBuf,
        /// What is in the way, and what to do.
        message: String,
    },
}

impl RecordingError {
    /// Attaches the path to an input or output error, for `map_err`.
    pub(crate) fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |cause| Self::Io { path, cause }
    }
}
