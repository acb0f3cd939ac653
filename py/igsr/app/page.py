"""The page of ``igsr app``: its parts, and which event changes which."""

from __future__ import annotations

from typing import Any

import gradio as gr

from igsr.app.events import Events
from igsr.app.intake import HOW_TO
from igsr.app.results import MAX_COMPARED
from igsr.app.runs import QUALITIES, Runs

CSS = """
.photos .grid-container { grid-template-columns: repeat(auto-fill, minmax(90px, 1fr)) !important; }
.scene iframe { width: 100%; height: min(70vh, 42rem); border: 0; border-radius: 8px; }
.scene progress { width: 100%; height: 1rem; }
.runs { display: flex; flex-wrap: wrap; gap: 1rem; }
.runs a { width: 11rem; }
.runs img { width: 11rem; height: 8rem; object-fit: cover; background: #8884; border-radius: 8px; }
"""
_QUIET: dict[str, Any] = {"show_progress": "hidden", "api_visibility": "private"}
_OPEN_RUN = "(name) => { if (name) location.search = '?run=' + name; }"
_OPEN_START = "(confirmed) => { if (confirmed) location.href = './'; }"
_CONFIRM = "() => confirm('Delete this scene and its photos?') ? String(Date.now()) : ''"


def make_page(runs: Runs) -> gr.Blocks:
    """Return the page for the runs of a folder."""
    events = Events(runs)
    with gr.Blocks(title="igsr", analytics_enabled=False, delete_cache=(3600, 86400)) as page:
        name = gr.State("")
        drawn = gr.State("")  # the state of the run that the results show
        with gr.Column(visible=False) as start:
            gr.Markdown(f"# A scene from photos\n{HOW_TO} Or use a video.")
            # Types of files would refuse a folder with other files in it.
            files = gr.File(label="Photos or a video", file_count="multiple", height=200)
            folder = gr.UploadButton("Choose a folder", file_count="directory", size="sm")
            notes = gr.HTML()
            thumbnails = gr.Gallery(
                label="Photos", height="auto", visible=False, elem_classes="photos"
            )
            quality = gr.Radio(
                list(QUALITIES), value="normal", label="Quality", info="Higher takes longer."
            )
            with gr.Accordion("More options", open=False):
                holdout = gr.Number(0, label="Test photos: every Nth; 0: none", precision=0)
                leave_out = gr.Checkbox(False, label="Leave out photos that cannot be placed")
                seed = gr.Number(0, label="Seed", precision=0)
            make = gr.Button("Make the scene", variant="primary")
            example = gr.Button("Use the example photos", size="sm")
            cards = gr.HTML()
        with gr.Column(visible=False, elem_classes="scene") as scene:
            gr.HTML('<a href="./">New scene</a>')
            status = gr.HTML()
            with gr.Row():
                stop = gr.Button("Stop", visible=False, size="sm")
                resume = gr.Button("Continue", visible=False, size="sm")
                delete = gr.Button("Delete", visible=False, size="sm")
            view = gr.HTML()
            results = gr.HTML()
            with gr.Row():
                sliders = [
                    gr.ImageSlider(
                        label="Photo and render", visible=False, interactive=False, min_width=320
                    )
                    for _ in range(MAX_COMPARED)
                ]
            with gr.Accordion("Log", open=False):
                log = gr.Textbox(show_label=False, lines=8, interactive=False)
        made, confirmed = gr.Textbox(visible=False), gr.Textbox(visible=False)
        clock = gr.Timer(1.0, active=False)

        for function in (events.run_state, events.stop_run, events.resume_run):
            gr.api(function)
        page.load(events.open_page, None, [name, start, scene, view, cards, clock], **_QUIET)
        shown = [drawn, status, stop, resume, delete, log, results, *sliders]
        clock.tick(events.update, [name, drawn], shown, **_QUIET)
        folder.upload(lambda chosen: chosen, folder, files, **_QUIET)
        files.change(events.check, files, [notes, thumbnails], api_visibility="private")
        settings = [quality, holdout, leave_out, seed]
        make.click(
            events.make_scene,
            [files, *settings],
            made,
            api_name="make_scene",
            show_progress_on=notes,
        )
        example.click(events.make_example, settings, made, api_name="make_example")
        made.change(None, made, None, js=_OPEN_RUN, **_QUIET)
        stop.click(events.stop_run, name, None, **_QUIET)
        resume.click(events.resume_run, name, None, **_QUIET)
        delete.click(None, None, confirmed, js=_CONFIRM, **_QUIET)
        deleted = confirmed.change(events.delete_run, [name, confirmed], None, **_QUIET)
        deleted.success(None, confirmed, None, js=_OPEN_START, **_QUIET)
    return page
