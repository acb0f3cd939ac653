"""``igsr denoise``: render views of a scene and denoise them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from igsr.cli.denoiser_option import DenoiserOption, chosen_denoiser
from igsr.cli.error_messages import error_messages
from igsr.cli.options import (
    BackendOption,
    JsonOption,
    SplitName,
    load,
    option,
    resolved,
)
from igsr.cli.output import output_console, print_json


def denoise_command(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="Splats (.ply).")],
    capture_path: Annotated[
        Path,
        option("--capture", metavar="CAPTURE", help="Photos that the splats were fitted to."),
    ],
    out: Annotated[Path, option("--out", metavar="DIR", help="Folder for the images.")],
    holdout: Annotated[
        int | None, option("--holdout", help="Hold out every Nth photo for testing.")
    ] = None,
    split: Annotated[
        SplitName | None,
        option("--split", help="Views to render. Default: test if there are any, else train."),
    ] = None,
    denoiser_name: DenoiserOption = None,
    backend: BackendOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Render views and denoise them: NAME.png, and NAME.confidence.png (white: confident)."""
    import numpy as np
    from PIL import Image

    from igsr._internal.atomic_write import atomic_write
    from igsr.capture.write_files import unique_stems
    from igsr.denoiser import (
        NetworkDenoiser,
        denoise,
        load_network,
        photo_sources,
        photo_support,
        render_buffers,
    )
    from igsr.evaluation.scores import (
        default_background,
        default_split,
        known_background,
        views_of_split,
    )
    from igsr.splats import Splats

    with error_messages():
        denoiser = chosen_denoiser(
            denoiser_name, lambda weights: NetworkDenoiser(load_network(weights))
        )
        splats = Splats.load(scene).without_backdrop()  # the denoiser fills holes
        capture = load(capture_path, holdout)
        background, known = default_background(capture), known_background(capture.views)
        name = resolved(backend)
        views = views_of_split(capture, split or default_split(capture))
        photos = capture.train_views
        support = photo_support(splats, photos, name)
        sources = photo_sources(splats, photos, background, name)
        files = []
        ends = (".png", ".confidence.png")
        stems = unique_stems((view.name for view in views), *ends)
        for view, stem in zip(views, stems, strict=True):
            buffers = render_buffers(splats, view.camera, support, known, name)
            others = [
                source
                for source, photo in zip(sources, photos, strict=True)
                if photo.name != view.name
            ]
            picture, confidence = denoise(buffers, others, denoiser)
            for array, end in zip((picture, confidence), ends, strict=True):
                file = out / f"{stem}{end}"
                with atomic_write(file) as temporary:
                    pixels = np.rint(255.0 * array).astype(np.uint8)
                    Image.fromarray(pixels).save(temporary, format="PNG")
                files.append(str(file))
    if as_json:
        print_json({"files": files})
        return
    output_console().print(f"{len(views)} views: {out}")
