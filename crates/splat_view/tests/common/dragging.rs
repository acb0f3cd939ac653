//! A file manager that drops a file on a window, by X11's protocol for that (XDND 5).

use std::path::Path;

use x11rb::connection::Connection;
use x11rb::protocol::Event;
use x11rb::protocol::xproto::{
    ClientMessageEvent, ConnectionExt as _, CreateWindowAux, EventMask, PropMode,
    SELECTION_NOTIFY_EVENT, SelectionNotifyEvent, WindowClass,
};
use x11rb::wrapper::ConnectionExt as _;

/// Drops a file or folder on a window of a display, and returns once the window has taken it.
pub fn drop_file(display: &str, window: u32, path: &Path) {
    let (x, screen) = x11rb::connect(Some(display)).expect("the display answers");
    let root = x.setup().roots[screen].root;
    let source = x.generate_id().expect("a window's number");
    let (depth, class) = (x11rb::COPY_DEPTH_FROM_PARENT, WindowClass::INPUT_OUTPUT);
    x.create_window(depth, source, root, 0, 0, 1, 1, 0, class, 0, &CreateWindowAux::new())
        .expect("a window");
    let atom = |name: &str| {
        x.intern_atom(false, name.as_bytes()).expect("sent").reply().expect("an atom").atom
    };
    let (uris, selection) = (atom("text/uri-list"), atom("XdndSelection"));
    x.set_selection_owner(source, selection, x11rb::CURRENT_TIME).expect("the selection");
    let tell = |name: &str, data: [u32; 5]| {
        let message = ClientMessageEvent::new(32, window, atom(name), data);
        x.send_event(false, window, EventMask::NO_EVENT, message).expect("sent");
        x.flush().expect("sent");
    };
    tell("XdndEnter", [source, 5 << 24, uris, 0, 0]);
    tell("XdndPosition", [source, 0, 100 << 16 | 100, x11rb::CURRENT_TIME, atom("XdndActionCopy")]);
    let uri = format!("file://{}\r\n", path.display());
    let (status, finished) = (atom("XdndStatus"), atom("XdndFinished"));
    let (mut is_accepted, mut is_read) = (false, false);
    loop {
        match x.wait_for_event().expect("an event") {
            Event::SelectionRequest(asked) => {
                let (window, property) = (asked.requestor, asked.property);
                x.change_property8(PropMode::REPLACE, window, property, uris, uri.as_bytes())
                    .expect("a property");
                let notice = SelectionNotifyEvent {
                    response_type: SELECTION_NOTIFY_EVENT,
                    sequence: 0,
                    time: asked.time,
                    requestor: asked.requestor,
                    selection: asked.selection,
                    target: asked.target,
                    property: asked.property,
                };
                x.send_event(false, asked.requestor, EventMask::NO_EVENT, notice).expect("sent");
                x.flush().expect("sent");
                is_read = true;
            }
            Event::ClientMessage(message) if message.type_ == status => {
                assert_eq!(message.data.as_data32()[1] & 1, 1, "the window refuses files");
                is_accepted = true;
            }
            Event::ClientMessage(message) if message.type_ == finished => return,
            _ => continue,
        }
        if is_accepted && is_read {
            tell("XdndDrop", [source, 0, x11rb::CURRENT_TIME, 0, 0]);
        }
    }
}
