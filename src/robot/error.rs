use std::path::PathBuf;

/// Why a robot description could not be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RobotError {
    /// A file could not be read.
    #[error("{}: {cause}", path.display())]
    Io {
        /// The file.
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
}

impl RobotError {
    /// Attaches the path to an input or output error, for `map_err`.
    pub(super) fn io(path: impl Into<PathBuf>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.into();
        move |cause| Self::Io { path, cause }
    }
}
