//! Output and browser start of an editor's page.

use vizflyt_process::{open_browser, print_line};
use vizflyt_server::render::RendererInfo;

/// Returns a callback that prints the renderer and the address of a page, and opens the browser unless `quiet`.
pub(crate) fn show_page(quiet: bool) -> impl FnOnce(&str, &RendererInfo) {
    move |url, renderer| {
        print_line(format!("renderer    {} ({})", renderer.name, renderer.reason));
        print_line(format!("page        {url}"));
        if !quiet {
            open_browser(url);
        }
    }
}
