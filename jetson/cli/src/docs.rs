//! `vizflyt docs`: the documentation site, served from this machine: labs have no internet.

use std::net::SocketAddr;
use std::path::{Component, Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail};
use axum::Router;
use axum::extract::State;
use axum::http::{StatusCode, Uri, header};
use axum::response::{IntoResponse, Response};
use clap::Args;
use vizflyt_process::{open_browser, print_line};

/// Arguments of `vizflyt docs`.
#[derive(Args, Debug)]
pub(crate) struct DocsArgs {
    /// Page to open, such as `safety` or `guides/plugin` [default: the first page]
    page: Option<String>,
    /// Folder of the site, as docs/site/build makes it [default: the installed one]
    #[arg(long, value_name = "FOLDER")]
    site: Option<PathBuf>,
    /// Address and port to serve the site on
    #[arg(long, value_name = "ADDR:PORT", default_value = "127.0.0.1:0")]
    listen: SocketAddr,
    /// Do not open a browser
    #[arg(long)]
    headless: bool,
}

/// Serves the site until it is interrupted.
pub(crate) fn run(args: &DocsArgs) -> Result<ExitCode> {
    let site = match &args.site {
        Some(folder) if folder.join("index.html").is_file() => folder.clone(),
        Some(folder) => bail!(
            "{} has no index.html: docs/site/build PROGRAM FOLDER makes the site",
            folder.display()
        ),
        None => installed().context(
            "this installation has no documentation: from the source tree, build it with \
             `docs/site/build target/debug/vizflyt`, or name its folder with --site",
        )?,
    };
    let page = args.page.as_deref().map_or(Ok(String::new()), |name| find(&site, name))?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let listener = tokio::net::TcpListener::bind(args.listen)
            .await
            .with_context(|| format!("cannot serve on {}", args.listen))?;
        let url = format!("http://{}/{page}", listener.local_addr()?);
        print_line(format!("docs        {url}"));
        if !args.headless {
            open_browser(&url);
        }
        axum::serve(listener, Router::new().fallback(serve).with_state(site)).await?;
        Ok(ExitCode::SUCCESS)
    })
}

/// Returns the site's folder: where packages and wheels install it, or where docs/site/build leaves it.
fn installed() -> Option<PathBuf> {
    let program = std::env::current_exe().ok()?.canonicalize().ok()?;
    let folder = program.parent()?.parent()?;
    ["share/doc/vizflyt/html", "site-sources/site"]
        .map(|site| folder.join(site))
        .into_iter()
        .find(|site| site.join("index.html").is_file())
}

/// Returns the address of the page `name`: its path, or the last part of it.
fn find(site: &Path, name: &str) -> Result<String> {
    let name = name.trim_matches('/').trim_end_matches(".md");
    let pages = pages(site);
    let is_named = |page: &&String| {
        page.trim_end_matches('/') == name
            || page.trim_end_matches('/').rsplit('/').next().is_some_and(|last| last == name)
    };
    // The shortest one: `safety` is a guide, before a decision of the same name.
    if let Some(page) = pages.iter().filter(is_named).min_by_key(|page| page.len()) {
        return Ok(page.clone());
    }
    let close: Vec<&str> =
        pages.iter().filter(|page| page.contains(name)).map(String::as_str).collect();
    if close.is_empty() {
        bail!("no page is named '{name}': open `vizflyt docs` and search there");
    }
    bail!("no page is named '{name}'; these contain it: {}", close.join(", "))
}

/// Returns the addresses of all pages, such as `guides/safety/`.
fn pages(site: &Path) -> Vec<String> {
    let (mut pages, mut folders) = (Vec::new(), vec![site.to_owned()]);
    while let Some(folder) = folders.pop() {
        let entries = std::fs::read_dir(&folder).into_iter().flatten().flatten();
        folders.extend(entries.map(|entry| entry.path()).filter(|path| path.is_dir()));
        if folder != site && folder.join("index.html").is_file() {
            let page = folder.strip_prefix(site).unwrap_or(&folder).to_string_lossy();
            pages.push(format!("{page}/"));
        }
    }
    pages.sort();
    pages
}

async fn serve(State(site): State<PathBuf>, uri: Uri) -> Response {
    let Some(path) = file(&site, uri.path()) else {
        return (StatusCode::NOT_FOUND, "no such page\n").into_response();
    };
    match tokio::fs::read(&path).await {
        Ok(bytes) => ([(header::CONTENT_TYPE, content_type(&path))], bytes).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, format!("{error}\n")).into_response(),
    }
}

/// Returns the file behind an address, if there is one beneath `site`.
fn file(site: &Path, address: &str) -> Option<PathBuf> {
    let relative = Path::new(address.trim_start_matches('/'));
    let is_beneath = relative.components().all(|part| matches!(part, Component::Normal(_)));
    let mut path = site.join(relative);
    if path.is_dir() {
        path.push("index.html");
    }
    (is_beneath && path.is_file()).then_some(path)
}

fn content_type(path: &Path) -> &'static str {
    match path.extension().and_then(|ending| ending.to_str()) {
        Some("html") => "text/html; charset=utf-8",
        Some("css") => "text/css; charset=utf-8",
        Some("js") => "text/javascript; charset=utf-8",
        Some("json") => "application/json",
        Some("svg") => "image/svg+xml",
        Some("png") => "image/png",
        Some("jpg") => "image/jpeg",
        Some("webp") => "image/webp",
        Some("woff2") => "font/woff2",
        Some("md" | "py" | "rs" | "toml" | "txt") => "text/plain; charset=utf-8",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn site() -> tempfile::TempDir {
        let site = tempfile::tempdir().unwrap();
        for page in ["", "guides/safety", "guides/plugin", "decisions/0001-safety/safety"] {
            let folder = site.path().join(page);
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join("index.html"), page).unwrap();
        }
        site
    }

    #[test]
    fn finds_a_page_by_its_name_or_path() {
        let site = site();
        for name in ["safety", "guides/safety", "/guides/safety/", "safety.md"] {
            assert_eq!(find(site.path(), name).unwrap(), "guides/safety/", "{name}");
        }
        let error = find(site.path(), "plug").unwrap_err().to_string();
        assert!(error.contains("guides/plugin/"), "{error}");
        let error = find(site.path(), "zebra").unwrap_err().to_string();
        assert!(error.contains("search"), "{error}");
    }

    #[test]
    fn serves_files_beneath_the_site_only() {
        let site = site();
        let served = |address| file(&site.path().join("guides"), address);
        assert!(served("/safety/").unwrap().ends_with("guides/safety/index.html"));
        assert!(served("/safety/index.html").is_some());
        for address in
            ["/../index.html", "/safety/../../index.html", "//etc/passwd", "/none", "/.."]
        {
            assert_eq!(served(address), None, "{address}");
        }
    }
}
