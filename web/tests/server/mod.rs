//! A web server for one test.

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;

/// Serves the files of `folders` on this machine alone, and nothing at all at `/empty`: its address.
pub fn serve(folders: Vec<Box<Path>>) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for connection in listener.incoming() {
            // A browser that goes away needs no answer.
            let _ = connection.and_then(|connection| answer(connection, &folders));
        }
    });
    address
}

fn answer(mut connection: TcpStream, folders: &[Box<Path>]) -> std::io::Result<()> {
    let mut lines = BufReader::new(connection.try_clone()?).lines();
    let request = lines.next().transpose()?.unwrap_or_default();
    while lines
        .next()
        .transpose()?
        .is_some_and(|header| !header.is_empty())
    {}
    let path = request.split([' ', '?']).nth(1).unwrap_or_default();
    let name = match path.trim_start_matches('/') {
        "" => "index.html",
        name => name,
    };
    let mut files = folders
        .iter()
        .map(|folder| std::fs::read(folder.join(name)));
    let file = files.find_map(Result::ok);
    let (status, body) = match file {
        Some(file) => ("200 OK", file),
        None if name == "empty" => ("200 OK", Vec::new()),
        None => ("404 Not Found", Vec::new()),
    };
    let kind = match name.rsplit_once('.').map(|(_, ending)| ending) {
        Some("html") | None => "text/html",
        Some("js") => "text/javascript",
        Some("css") => "text/css",
        Some("svg") => "image/svg+xml",
        Some("wasm") => "application/wasm",
        Some(_) => "application/octet-stream",
    };
    let length = body.len();
    write!(
        connection,
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n"
    )?;
    connection.write_all(&body)
}
