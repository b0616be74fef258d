use std::path::PathBuf;

use crate::cascade::LocateError;

/// A value that is no number where one was expected. It is never averaged away.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{what}: expected finite numbers, found {found}")]
pub struct NotFinite {
    /// What the value belongs to.
    pub what: &'static str,
    /// The value.
    pub found: f64,
}

/// Why a model could not be judged.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EvaluationError {
    /// An image could not be searched.
    #[error(transparent)]
    Locate(#[from] LocateError),
    /// The model said something that is no number.
    #[error(transparent)]
    NotFinite(#[from] NotFinite),
    /// The model has other joints than the truth.
    #[error("joints: expected the model's {expected:?}, found {found:?}")]
    Joints {
        /// The model's joints.
        expected: Vec<String>,
        /// The recording's.
        found: Vec<String>,
    },
    /// A file of annotations could not be read.
    #[error("{}: {cause}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        cause: std::io::Error,
    },
    /// An annotation is not what the format asks for.
    #[error("{}:{line}: {message}", path.display())]
    Annotation {
        /// The file.
        path: PathBuf,
        /// The line, from 1, where the annotation ends or cannot be understood.
        line: usize,
        /// What was expected and what was found.
        message: String,
    },
}
