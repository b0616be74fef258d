use std::path::PathBuf;

use crate::gpu::GpuError;

/// Why a recording could not be made, read or continued.
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
    /// The robot description is not one that the recorder can use.
    #[error("{}: {message}", path.display())]
    Urdf {
        /// The URDF file.
        path: PathBuf,
        /// What was expected and what was found.
        message: String,
    },
    /// What a body's frames file says cannot be used.
    #[error("{}: {message}", path.display())]
    Frames {
        /// The frames file.
        path: PathBuf,
        /// What was expected and what was found.
        message: String,
    },
    /// A mesh that the robot description names is not there.
    #[error("{}: link \"{link}\" wants the mesh \"{name}\", which was not found (looked for {})", urdf.display(), looked_for.display())]
    MissingMesh {
        /// The URDF file.
        urdf: PathBuf,
        /// The link that wants the mesh.
        link: String,
        /// The mesh's name as the URDF gives it.
        name: String,
        /// Where it was expected.
        looked_for: PathBuf,
    },
    /// A mesh file could not be understood.
    #[error("{}: {message}", path.display())]
    Mesh {
        /// The mesh file.
        path: PathBuf,
        /// What was expected and what was found.
        message: String,
    },
    /// No picture in the folder could be used as a background.
    #[error("{}: expected at least one readable JPEG or PNG picture, found none", path.display())]
    NoBackgrounds {
        /// The folder.
        path: PathBuf,
    },
    /// A background picture could not be decoded.
    #[error("{}: {cause}", path.display())]
    Picture {
        /// The picture.
        path: PathBuf,
        /// What the decoder said.
        cause: image::ImageError,
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
    /// No scene that keeps the rules (camera, coverage, no collision) was found.
    #[error("sample {id}: found no pose without collision that fills the picture as asked")]
    NoScene {
        /// The sample's number.
        id: u64,
    },
    /// A sweep of the joints has too few poses that a fixed camera can see.
    #[error(
        "expected {wanted} poses without collision and with all joints in the picture, found {found}"
    )]
    TooFewPoses {
        /// How many samples were asked for.
        wanted: usize,
        /// How many poses there are.
        found: usize,
    },
    /// The GPU could not draw.
    #[error(transparent)]
    Gpu(#[from] GpuError),
}

impl RecordingError {
    /// Attaches the path to an input or output error, for `map_err`.
    pub(crate) fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |cause| Self::Io { path, cause }
    }
}
