//! The event loop: opens the window and passes its events on.

use std::time::Instant;

use splat_render::{Error, Result};
use winit::application::ApplicationHandler;
use winit::event::WindowEvent;
use winit::event_loop::{ActiveEventLoop, ControlFlow, EventLoop, EventLoopProxy};
use winit::window::WindowId;

use crate::arguments::Arguments;
use crate::screen::{Screen, reason};
use crate::session::{Session, Wake};
use crate::start::Start;

/// Opens a window and shows the command line's scene until it is closed.
pub fn run(arguments: Arguments) -> Result<()> {
    let start = Start::read(&arguments)?;
    let event_loop =
        EventLoop::<Wake>::with_user_event().build().map_err(|_| Error::Device(no_display()))?;
    let proxy = event_loop.create_proxy();
    let mut app = App { arguments, start: Some(start), proxy, session: None, failure: None };
    event_loop
        .run_app(&mut app)
        .map_err(|e| Error::Device(format!("the window failed ({}); open it again", reason(&e))))?;
    app.failure.map_or(Ok(()), Err)
}

/// The error message without a display.
fn no_display() -> String {
    let why = if cfg!(all(unix, not(target_os = "macos"))) {
        let set = |name: &&str| {
            let value = std::env::var_os(name).filter(|value| !value.is_empty())?;
            Some(format!("{name}={}", value.display()))
        };
        let set: Vec<String> = ["WAYLAND_DISPLAY", "DISPLAY"].iter().filter_map(set).collect();
        match set.is_empty() {
            true => ": neither WAYLAND_DISPLAY nor DISPLAY is set".to_owned(),
            false => format!(" at {}", set.join(" or ")),
        }
    } else {
        String::new()
    };
    format!(
        "no display was found{why}; start splat-view on a desktop, or draw without a window: \
         --screenshot FILE"
    )
}

struct App {
    arguments: Arguments,
    start: Option<Start>,
    proxy: EventLoopProxy<Wake>,
    session: Option<Session>,
    /// Why the program ends, if it fails.
    failure: Option<Error>,
}

impl App {
    fn open(&mut self, event_loop: &ActiveEventLoop) -> Result<Session> {
        let screen = Screen::open(event_loop, self.arguments.size)?;
        let mut session = Session::new(screen, self.arguments.clone(), self.proxy.clone())?;
        if let Some(start) = self.start.take() {
            session.begin(start)?;
        }
        session.screen.window.set_visible(true);
        session.screen.window.request_redraw();
        Ok(session)
    }

    fn end(&mut self, event_loop: &ActiveEventLoop, result: Result<()>) {
        if let Err(error) = result {
            self.failure.get_or_insert(error);
            event_loop.exit();
        }
    }
}

impl ApplicationHandler<Wake> for App {
    fn resumed(&mut self, event_loop: &ActiveEventLoop) {
        if self.session.is_none() {
            match self.open(event_loop) {
                Ok(session) => self.session = Some(session),
                Err(error) => self.end(event_loop, Err(error)),
            }
        }
    }

    fn window_event(&mut self, event_loop: &ActiveEventLoop, _: WindowId, event: WindowEvent) {
        let Some(session) = &mut self.session else { return };
        session.screen.pass_to_egui(&event);
        let result = match event {
            WindowEvent::CloseRequested => {
                event_loop.exit();
                Ok(())
            }
            WindowEvent::Resized(size) => {
                // At once: a frame of the old size would be stretched.
                session.screen.resize(size.width, size.height).and_then(|()| session.frame())
            }
            WindowEvent::DroppedFile(path) => {
                session.dropped(&path);
                Ok(())
            }
            WindowEvent::RedrawRequested => session.frame(),
            _ => Ok(()),
        };
        self.end(event_loop, result);
    }

    fn user_event(&mut self, _: &ActiveEventLoop, _: Wake) {
        let Some(session) = &mut self.session else { return };
        session.receive();
    }

    fn about_to_wait(&mut self, event_loop: &ActiveEventLoop) {
        let Some(session) = &mut self.session else { return };
        let next = session.idle(Instant::now());
        event_loop.set_control_flow(ControlFlow::WaitUntil(next));
    }
}
