"""The contract types of `lint-imports` that see through the interfaces of packages.

A file that imports `Log` from `trilat_net.log` needs the module `log.log_reader` alone, because a package imports
the module of a name when the name is used. Import Linter would see an import of the package, which names all of its
modules. Contracts about indirect imports are checked here on the imports that a program really does.
"""

import grimp
from importlinter import ContractCheck
from importlinter.contracts.forbidden import ForbiddenContract

from . import house


def see_through_interfaces(graph: grimp.ImportGraph) -> None:
    """Replaces, in a graph, the imports of interfaces by those of the modules that define the names."""
    for package in house.INTERFACES:
        for module in graph.find_modules_directly_imported_by(package):
            if module.startswith(f"{package}."):
                graph.remove_import(importer=package, imported=module)
    for path in house.files():
        importer = house.dotted(path)
        if importer not in graph.modules or importer in house.INTERFACES:
            continue
        written = list(house.written_imports(path))
        for names, parts in zip(written, house.imported_names(path), strict=True):
            package = ".".join(names[:-1])
            if names == parts or not graph.direct_import_exists(
                importer=importer, imported=package
            ):
                continue
            home = ".".join(parts if house.find_file(parts) else parts[:-1])
            details = graph.get_import_details(importer=importer, imported=package)
            graph.add_import(
                importer=importer,
                imported=home,
                line_number=details[0]["line_number"],
                line_contents=details[0]["line_contents"],
            )
        for package in house.INTERFACES:
            members = [names[-1] for names in written if ".".join(names[:-1]) == package]
            if members and {*members} <= {*house.list_interface(package)}:
                graph.remove_import(importer=importer, imported=package)


class ForbiddenModules(ForbiddenContract):
    """Forbids imports, as `forbidden` does, of the modules behind the names of interfaces."""

    type_name = "forbidden"

    def check(self, graph: grimp.ImportGraph, verbose: bool) -> ContractCheck:
        """Checks the contract. Import Linter calls this method with a copy of the graph."""
        see_through_interfaces(graph)
        return super().check(graph, verbose)
