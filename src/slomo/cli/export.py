"""The command that gives results to other programs."""

from pathlib import Path
from typing import Annotated

import typer

from slomo.cli.session import Session, command
from slomo.errors import MissingInput, UsageError


def add_commands(app: typer.Typer) -> None:
    """Register the command with `app`."""

    @command(app, "export")
    def export(
        session: Session,
        mesh: Annotated[
            Path | None,
            typer.Option("--mesh", metavar="FILE.glb|FILE.ply|FOLDER", help="Where to write the body's surface."),
        ] = None,
        every: Annotated[int, typer.Option("--every", min=1, help="Only every n-th pose of the motion.")] = 1,
        rest: Annotated[bool, typer.Option("--rest", help="The body at rest, without its motion.")] = False,
    ) -> None:
        """The reconstructed body as a coloured mesh: an animation (.glb), a PLY file a frame, or at rest (.ply).

        \b
        slomo export --mesh cat.glb
        slomo export --mesh frames --every 2
        slomo export --mesh cat.ply
        """
        from slomo.mesh import SkinnedMesh
        from slomo.mesh_files import check_target, write_meshes

        if mesh is None:
            raise UsageError("what is to be exported?", where="export", valid=("--mesh",))
        check_target(mesh, rest=rest, every=every)
        artifact = session.runner(session.project()).current("reconstruct", wanted_by="export")
        if "mesh.npz" not in artifact.npz:
            todo = "run `slomo reconstruct --fresh` first"
            raise MissingInput("the reconstruction has no mesh.npz", where="export", todo=todo)
        body = SkinnedMesh.from_arrays(artifact.npz["mesh.npz"]).every(every)
        session.console.start("export")
        files = write_meshes(body, mesh, rest=rest, shown=session.console.update)
        size = sum(f.stat().st_size for f in files)
        session.console.done(f"{len(body.vertices)} vertices, {size / 1e6:.1f} MB")
        still = rest or mesh.suffix == ".ply"
        found = {
            "path": str(mesh.absolute()), "files": len(files), "bytes": size, "poses": 1 if still else len(body.t),
            "vertices": len(body.vertices), "triangles": len(body.faces), "links": list(body.link_names),
        }  # fmt: skip
        session.emit(str(mesh.absolute()), found)
