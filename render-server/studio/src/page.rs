//! How a page of an editor is shown.

use vizflyt_process::{open_browser, print_line};
use vizflyt_server::render::RendererInfo;

/// Returns what reports a page that answers: what draws it and its address; and opens it, if that is not to be `quiet`.
pub(crate) fn show_page(quiet: bool) -> impl FnOnce(&str, &RendererInfo) {
    move |url, renderer| {
        print_line(format!("renderer    {} ({})", renderer.name, renderer.reason));
        print_line(format!("page        {url}"));
        if !quiet {
            open_browser(url);
        }
    }
}
