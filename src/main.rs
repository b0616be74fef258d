//! The `whereabot` command.

fn main() -> std::process::ExitCode {
    whereabot::cli::main()
}
