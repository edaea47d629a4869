"""The command `report`: writes the HTML report of a result."""

from shapepose_fg.cli.options import ResultOptions, grouped


@grouped
def report(result: ResultOptions) -> None:
    """Write report.html again: a page for the browser, with the people in 3D and the quality of the
    result.
    """
    from shapepose_fg.viz.report.writing import report_of

    print(report_of(result.results, body=result.body, **result.how()))
